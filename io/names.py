"""Names of files and folders, as people give them."""


def fault_of_name(name: str) -> str | None:
    """Return why this cannot be the name of a file or folder. None: it can.

    Tables, JSON and Prefect hold text in UTF-8. An empty name would mean the current folder.
    """
    if not name.strip():
        return "the name is empty; give a path or a URL"
    if "\0" in name:
        return "the name has a zero character; give another one"
    try:
        name.encode()
    except UnicodeEncodeError:
        return "the name is not UTF-8; rename it"
    return None

"""Names of files and folders, as people give them."""

import errno
import os
from pathlib import Path

LONGEST_PART, LONGEST_PATH = 255, 4095  # bytes that Linux takes


def fault_of_name(name: str) -> str | None:
    """Return why this cannot be the name of a file or folder. None: it can.

    Tables, JSON and Prefect hold text in UTF-8. An empty name would mean the current folder.
    """
    if not name.strip():
        return "the name is empty; give a path or a URL"
    if "\0" in name:
        return "the name has a zero character; give another one"
    parts = [len(os.fsencode(part)) for part in name.split("/")]
    if "://" not in name and (max(parts) > LONGEST_PART or sum(parts) + len(parts) > LONGEST_PATH):
        return "the name is too long; give a shorter one"
    try:
        name.encode()
    except UnicodeEncodeError:
        return "the name is not UTF-8; rename it"
    return None


def refuse_device(path: Path) -> None:
    """Raise where a path is a pipe or a device, of which reading may never end.

    Raises
    ------
    OSError
        Says so.
    """
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise OSError(errno.EINVAL, "is a pipe or a device, not a file", str(path))

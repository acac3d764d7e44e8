"""Text from outside: names in logs and of files, TOML, URLs. It is escaped where it is shown.

A name may have any content: line ends, commands to the terminal, HTML, links. Tables keep it
unchanged.
"""

import re
import tomllib
from typing import Any

LONGEST_LINE = 1000
# Characters that could be marks in Markdown, or in the HTML in it.
_MARKED = re.compile(r"[^\w\s,.;/()=+%-]|_|(?<=www)\.", re.IGNORECASE)


def as_line(text: object, longest: int = LONGEST_LINE) -> str:
    """Return a text as one line, cut to `longest`; ``\\n`` and the like become escapes."""
    line = "".join(c if c.isprintable() else _escaped(c) for c in str(text)[: longest + 1])
    return line if len(line) <= longest else line[: longest - 3] + "..."


def as_markdown_text(text: object, longest: int = LONGEST_LINE) -> str:
    """Return Markdown that shows a text as it is: without links, HTML or other marks."""
    return _MARKED.sub(lambda mark: f"&#{ord(mark.group())};", as_line(text, longest))


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")


# TOML: invalid text is a ValueError.

DEEPEST = 50  # levels of tables and lists; no file of ours has more than four
_TOO_DEEP = "brackets or dotted keys are nested too deep"


def toml_values(text: str) -> dict[str, Any]:
    """Return the nested mappings of a TOML text.

    Raises
    ------
    ValueError
        Where it is not TOML, is nested too deep, or has a number of thousands of digits.
    """
    try:
        values = tomllib.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    _check_depth(values)
    return values


def _check_depth(values: dict[str, Any]) -> None:
    """Raise where values are nested too deep: not even a message could show them then."""
    level: list[Any] = [values]
    for _ in range(DEEPEST):
        if not level:
            return
        level = [inner for outer in level for inner in _inside(outer)]
    raise ValueError(_TOO_DEEP)


def _inside(value: Any) -> list[Any]:
    """Return the tables and lists directly in a value."""
    inside = value.values() if isinstance(value, dict) else value
    return [inner for inner in inside if isinstance(inner, dict | list)]


# URLs without their secrets, as they are shown and stored.

_USER = re.compile(r"(?<=://)[^/?#\n]*@")
# A query or a fragment, with its end in a sentence. A glob such as night-?.mcap has no query.
_QUERY = re.compile(r"(://[^\s'\"<>?#]*)[?#]([^\s'\"<>]*=[^\s'\"<>]*|[\w%~+/-]{16,})")
_ENDS = ".,:;)]}"

# Parameters of a query that say which file it is. All others are removed: a signature, a token and
# their time of expiry have another name in each store.
_PLAIN = {"file", "filename", "path", "name", "version", "versionid"}


def without_secrets(text: str) -> str:
    """Return a text with its URLs as they may be shown: without user, password and signature.

    ``https://me:pw@host/a.mcap?token=x`` becomes ``https://host/a.mcap``. So a URL stays the same
    when its password changes.
    """
    return _QUERY.sub(_without_values, _USER.sub("", text)) if "://" in text else text


def _without_values(found: re.Match[str]) -> str:
    query = found[2].rstrip(_ENDS)
    pairs = [pair for pair in query.split("&") if pair.partition("=")[0].lower() in _PLAIN]
    return found[1] + ("?" + "&".join(pairs) if pairs else "") + found[2][len(query) :]

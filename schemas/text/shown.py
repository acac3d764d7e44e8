"""Text from outside, such as a name in a log or of a file, as it is shown to people.

It may have any content: line ends, commands to the terminal, HTML, links. It is escaped where it
is shown; tables keep it as it is.
"""

import re

LONGEST_LINE = 1000
# What Markdown, or the HTML in it, could take for more than text.
_MARKED = re.compile(r"[^\w\s,.;/()=+%-]|_|(?<=www)\.", re.IGNORECASE)


def as_line(text: object, longest: int = LONGEST_LINE) -> str:
    """Return a text as one line: what cannot be printed as an escape, such as ``\\n``, and cut."""
    line = "".join(c if c.isprintable() else _escaped(c) for c in str(text)[: longest + 1])
    return line if len(line) <= longest else line[: longest - 3] + "..."


def as_markdown_text(text: object, longest: int = LONGEST_LINE) -> str:
    """Return Markdown that shows a text as it is: without links, HTML or other marks."""
    return _MARKED.sub(lambda mark: f"&#{ord(mark.group())};", as_line(text, longest))


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode("ascii")

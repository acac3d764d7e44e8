"""Pieces of HTML: tables, figures and sections. All text is escaped here."""

import html
from collections.abc import Iterable, Sequence
from typing import NamedTuple
from urllib.parse import quote

from epipole.schemas.text import as_line

LONGEST_CELL = 250
LONG_CELL = 36  # has more than one line
FEW_COLUMNS = 5  # more do not fit on a phone
# What a data address may have as it is; quotes and ampersands are escaped for the attribute.
_PLAIN = " !$&()*+,-./:;<=>?@[]^_`{|}~'"


class Section(NamedTuple):
    """A section of the page; `body` is HTML."""

    anchor: str
    title: str
    body: str


def text(value: object, longest: int = 1000) -> str:
    """Return a text as HTML that shows it as it is, in one line."""
    return html.escape(as_line(value, longest))


def paragraph(sentence: str, kind: str = "") -> str:
    """Return a paragraph of plain text."""
    return f"<p{_class(kind)}>{text(sentence)}</p>\n"


def nothing(sentence: str) -> str:
    """Return the text for a picture without data."""
    return paragraph(sentence, "nothing")


def bullets(sentences: Iterable[str], kind: str = "") -> str:
    """Return a list of sentences."""
    return f"<ul{_class(kind)}>\n" + "".join(f"<li>{text(s)}</li>\n" for s in sentences) + "</ul>\n"


def table(caption: str, heading: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table that scrolls by itself. Numbers are to the right."""
    head = "".join(f'<th scope="col">{text(name)}</th>' for name in heading)
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>\n" for row in rows)
    label = html.escape(caption, quote=True)
    wide = " wide" if len(heading) > FEW_COLUMNS else ""
    return (
        f'<div class="scroll{wide}" role="region" tabindex="0" aria-label="{label}">\n'
        f"<table><caption>{text(caption)}</caption>\n<thead><tr>{head}</tr></thead>\n"
        f"<tbody>\n{body}</tbody></table></div>\n"
    )


def _cell(value: object) -> str:
    if isinstance(value, str) and not value[:1].isdigit() and value[:1] not in "+-":
        kind = ' class="t"' if isinstance(value, str) and len(value) > LONG_CELL else ""
        return f"<td{kind}>{text(value, LONGEST_CELL)}</td>"
    return f'<td class="n">{text(value)}</td>'


def figure(svg: str, alt: str, says: str) -> str:
    """Return a picture with the text that stands for it, and a sentence below."""
    address = quote(svg, safe=_PLAIN).replace("&", "&amp;")
    return (
        f'<figure><img src="data:image/svg+xml,{address}" alt="{text(alt)}">'
        f"<figcaption>{text(says)}</figcaption></figure>\n"
    )


def beside(left: str, right: str) -> str:
    """Return two parts beside each other where there is room, else one below the other."""
    return f'<div class="pair"><div>{left}</div><div>{right}</div></div>\n'


def figures(pictures: Iterable[str]) -> str:
    """Return pictures beside each other where there is room."""
    shown = list(pictures)
    kind = "figures one" if len(shown) == 1 else "figures"
    return f'<div class="{kind}">\n{"".join(shown)}</div>\n' if shown else ""


def tiles(numbers: Iterable[tuple[str, str]]) -> str:
    """Return a few numbers with their names."""
    each = (f"<div><dt>{text(name)}</dt><dd>{text(value)}</dd></div>\n" for name, value in numbers)
    return f'<dl class="tiles">\n{"".join(each)}</dl>\n'


def _class(kind: str) -> str:
    return f' class="{kind}"' if kind else ""

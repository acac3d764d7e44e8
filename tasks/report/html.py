"""Pieces of HTML: tables, figures and sections. All text is escaped here."""

import base64
import hashlib
import html
import re
from collections.abc import Iterable, Sequence
from math import floor, log10
from pathlib import Path
from string import Template
from typing import NamedTuple

from epipole.schemas.text import as_line

LONGEST_CELL = 250
LONG_CELL = 36  # has more than one line
NO_SIGMA = 1e-9  # smaller ones are none
FEW_COLUMNS = 5  # more do not fit on a phone


class Link(NamedTuple):
    """A text that leads to an anchor of the page, or to another page (with a dot in it)."""

    says: str
    anchor: str


class Section(NamedTuple):
    """A section of the page; `body` is HTML."""

    anchor: str
    title: str
    body: str


def section(part: Section) -> str:
    """Return a section with its heading."""
    return f'<section id="{part.anchor}">\n<h2>{text(part.title)}</h2>\n{part.body}</section>\n'


def text(value: object, longest: int = 1000) -> str:
    """Return a text as HTML that shows it as it is, in one line."""
    return html.escape(as_line(value, longest))


def paragraph(sentence: str, kind: str = "") -> str:
    """Return a paragraph of plain text."""
    return f"<p{_class(kind)}>{text(sentence)}</p>\n"


def nothing(sentence: str) -> str:
    """Return the text for a picture without data."""
    return paragraph(sentence, "nothing")


def bullets(sentences: Iterable[Link | str], kind: str = "") -> str:
    """Return a list of sentences; a `Link` leads to where the page shows it."""
    return f"<ul{_class(kind)}>\n" + "".join(map(_bullet, sentences)) + "</ul>\n"


def _bullet(sentence: Link | str) -> str:
    if isinstance(sentence, str):
        return f"<li>{text(sentence)}</li>\n"
    return f'<li>{text(sentence.says)} <a href="#{sentence.anchor}">Show it</a></li>\n'


def details(anchor: str, title: str, body: str) -> str:
    """Return a part of the page that opens on demand."""
    return f'<details id="{anchor}"><summary>{text(title)}</summary>\n{body}</details>\n'


def table(caption: str, heading: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table that scrolls by itself. Numbers are to the right."""
    rows = list(rows)
    right = [bool(rows) and all(_is_number(row[k]) for row in rows) for k in range(len(heading))]
    head = "".join(
        f'<th scope="col"{_class("n" if number else "")}>{text(name)}</th>'
        for name, number in zip(heading, right, strict=True)
    )
    body = "".join(f"<tr>{''.join(map(_cell, row))}</tr>\n" for row in rows)
    label = html.escape(caption, quote=True)
    wide = " wide" if len(heading) > FEW_COLUMNS else ""
    return (
        f'<div class="scroll{wide}" role="region" tabindex="0" aria-label="{label}">\n'
        f"<table><caption>{text(caption)}</caption>\n<thead><tr>{head}</tr></thead>\n"
        f"<tbody>\n{body}</tbody></table></div>\n"
    )


def _cell(value: object) -> str:
    if isinstance(value, Link):
        return f'<td><a href="{_target(value)}">{text(value.says, LONGEST_CELL)}</a></td>'
    if _is_number(value):
        return f'<td class="n">{text(value)}</td>'
    kind = "t" if isinstance(value, str) and len(value) > LONG_CELL else ""
    return f"<td{_class(kind)}>{text(value, LONGEST_CELL)}</td>"


def _target(link: Link) -> str:
    target = link.anchor if "." in link.anchor else f"#{link.anchor}"
    return html.escape(target, quote=True)


def _is_number(value: object) -> bool:
    if isinstance(value, str):
        return value[:1].isdigit() or value.startswith(("+", "-"))
    return not isinstance(value, Link)


def with_sigma(value: float, sigma: float) -> str:
    """Return a value to the second digit of its sigma."""
    if not NO_SIGMA < sigma < float("inf"):
        return f"{value:,.5g}"
    decimals = min(max(1 - floor(log10(sigma)), 0), 9)
    return f"{value:,.{decimals}f} ± {sigma:,.{decimals}f}"


def figure(svg: str, alt: str, says: str, anchor: str = "") -> str:
    """Return a picture with the text that stands for it, and a sentence below."""
    live = ' tabindex="0"' if "data-t=" in svg or "data-box=" in svg else ""
    shown = svg.replace("<svg ", f'<svg class="plot" role="img" aria-label="{text(alt)}"{live} ', 1)
    target = f' id="{anchor}"' if anchor else ""
    return f"<figure{target}>{shown}<figcaption>{text(says)}</figcaption></figure>\n"


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


# The document around all of it: page.html, with page.js inside, which the page allows by its hash.

WELL, LOOK = "well", "look"  # how the verdict on a night begins: `look 3` are three sentences
VERDICT = re.compile(r'<meta name="verdict" content="(\w+)')
_HERE = Path(__file__)


def document(title: str, head: str, contents: str, sections: str, verdict: str = "") -> str:
    """Return a page that needs no other file."""
    script = _HERE.with_name("page.js").read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    return Template(_HERE.with_name("page.html").read_text(encoding="utf-8")).substitute(
        title=text(title), verdict=text(verdict), digest=digest, head=head, contents=contents,
        sections=sections, script=script,
    )  # fmt: skip

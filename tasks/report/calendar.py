"""The calendar of a dataset: its nights by month, coloured by what is to be thought of them."""

import calendar
import datetime
import html
from collections.abc import Sequence
from statistics import median
from typing import Any, NamedTuple

from epipole.tasks.report.html import (
    LOOK,
    WELL,
    Link,
    Section,
    bullets,
    document,
    paragraph,
    section,
    table,
    text,
)
from epipole.tasks.report.night_facts import DROP, MIN_IDENTIFIED, MIN_NIGHTS, percent

MAX_LISTED = 400  # nights in the table
USUAL_OF = 29  # nights before, of which the median is taken
_MARKS = {WELL: ("good", "✓"), LOOK: ("bad", "!"), "": ("", "?")}
_DAYS = ("Mo", "Tu", "We", "Th", "Fr", "Sa", "Su")


class CalendarNight(NamedTuple):
    """A night of the calendar.

    row : of its table `nights`; None: it cannot be read
    looks : what needs a look, as its run has recorded it
    verdict : as its page says, `WELL` or `LOOK`; '' without a page
    address : of its page, relative to the calendar; '' without one that a browser can open
    """

    date: str
    row: dict[str, Any] | None
    looks: list[str]
    verdict: str
    address: str


class JudgedNight(NamedTuple):
    """A night, what is to be thought of it, and why; `counted`: it has no page that says so."""

    night: CalendarNight
    verdict: str
    reasons: list[str]
    counted: bool


def judge(nights: Sequence[CalendarNight]) -> list[JudgedNight]:
    """Return what is to be thought of each night.

    Its page says so; without a page, the record of its run; without what needs a look there, its
    table `nights`: sensors at fault, the share of frames identified, and numbers below those of the
    nights before, by the limits of the page.
    """
    judged: list[JudgedNight] = []
    for k, night in enumerate(nights):
        before = [each.row for each in nights[max(k - USUAL_OF, 0) : k] if each.row]
        recorded = night.looks if night.row else []
        reasons = recorded or _reasons(night.row, before)
        without_page = LOOK if reasons else WELL
        verdict = (night.verdict or without_page) if night.row else ""
        judged.append(JudgedNight(night, verdict, reasons, not night.verdict))
    return judged


def _reasons(row: dict[str, Any] | None, before: Sequence[dict[str, Any]]) -> list[str]:
    if row is None:
        return ["its table `nights` is missing or cannot be read"]
    found = [str(fault) for fault in row["faults"]]
    share = _share(row)
    if share < MIN_IDENTIFIED:
        found.append(f"{percent(share)} of the frames are identified")
    if not row["objects"]:
        found.append("no object is found")
    for name in ("frames", "objects", "positions") if len(before) >= MIN_NIGHTS else ():
        usual = median(each[name] for each in before)
        if row[name] < DROP * usual:
            found.append(f"fewer {name} than usual")
    return found


def calendar_page(dataset: str, nights: Sequence[CalendarNight]) -> str:
    """Return the calendar as HTML: one file that needs no other, with links to nights' pages."""
    judged = judge(nights)
    counts = {verdict: sum(each.verdict == verdict for each in judged) for verdict in _MARKS}
    about = f"{dataset} · {len(nights):,} nights"
    what = (
        f"Of the nights {counts[WELL]:,} are well (✓), {counts[LOOK]:,} need a look (!), "
        f"{counts['']:,} cannot be read (?). As the page of each night says; a "
        "dashed night has no page, and is judged by its run and its counts."
    )
    worst = [
        f"{each.night.date}: {'; '.join(each.reasons) or 'its page says why'}"
        for each in judged[::-1]
        if each.verdict != WELL
    ]
    sections = [Section("months", "Months", _months(judged)),
                Section("nights", "Nights", _table(judged))]  # fmt: skip
    head = paragraph(about, "about") + paragraph(what)
    if worst:
        head += f'<div class="look"><h2>Needs a look</h2>\n{bullets(worst[:MAX_LOOKS])}</div>\n'
    return document(
        "Nights",
        head=head,
        contents="".join(f'<li><a href="#{s.anchor}">{text(s.title)}</a></li>\n' for s in sections),
        sections="".join(map(section, sections)),
    )


MAX_LOOKS = 12  # the newest


def _months(judged: Sequence[JudgedNight]) -> str:
    by_date = {each.night.date: each for each in judged}
    months = sorted({date[:7] for date in by_date}, reverse=True)
    return f'<div class="calendar">\n{"".join(_month(month, by_date) for month in months)}</div>\n'


def _month(month: str, by_date: dict[str, JudgedNight]) -> str:
    year, number = int(month[:4]), int(month[5:])
    cells = [f'<span class="of-week">{day}</span>' for day in _DAYS]
    for week in calendar.Calendar().monthdatescalendar(year, number):
        cells += [_day(day, by_date) if day.month == number else "<span></span>" for day in week]
    title = f"{calendar.month_name[number]} {year}"
    days = "".join(cells)
    return f'<div class="month"><h3>{title}</h3><div class="days">{days}</div></div>\n'


def _day(day: datetime.date, by_date: dict[str, JudgedNight]) -> str:
    each = by_date.get(day.isoformat())
    if each is None:
        return f"<span>{day.day}</span>"
    colour, mark = _MARKS[each.verdict]
    kind = " ".join(filter(None, ("night", colour, "counted" if each.counted else "")))
    row = each.night.row or {}
    counts = f", {row['objects']:,} objects, {percent(_share(row))} identified" if row else ""
    says = f"{each.night.date}: {each.verdict or 'cannot be read'}{counts}"
    label = f'class="{kind}" title="{text(says)}" aria-label="{text(says)}"'
    shown = f"{day.day}{mark}"
    if not each.night.address:
        return f"<span {label}>{shown}</span>"
    return f'<a {label} href="{html.escape(each.night.address, quote=True)}">{shown}</a>'


def _share(row: dict[str, Any]) -> float:
    share: float = row["identified"] / row["frames"] if row["frames"] else 0.0
    return share


def _table(judged: Sequence[JudgedNight]) -> str:
    rows: list[tuple[object, ...]] = []
    for each in judged[::-1][:MAX_LISTED]:
        row, address = each.night.row, each.night.address
        name = Link(each.night.date, address) if address else each.night.date
        numbers = ("",) * 5 if row is None else (
            f"{row['frames']:,}", percent(_share(row)), f"{row['objects']:,}",
            f"{row['positions']:,}", f"{row['left_out']:,}",
        )  # fmt: skip
        rows.append((name, each.verdict or "cannot be read", *numbers, "; ".join(each.reasons)))
    caption = "Nights, the newest first"
    if len(judged) > len(rows):
        caption += f": {len(rows)} of {len(judged):,}"
    heading = (
        "night",
        "verdict",
        "frames",
        "identified",
        "objects",
        "positions",
        "left out",
        "why",
    )
    return table(caption, heading, rows)

"""The page of a night, and its extract for Prefect's page."""

from collections.abc import Sequence
from functools import partial

from epipole.schemas.text import as_line
from epipole.tasks.report.canvas import Draw, as_png
from epipole.tasks.report.draw_sensors import coverage_height, draw_coverage
from epipole.tasks.report.draw_sky import draw_elements, draw_half_normal, draw_normal, draw_ring
from epipole.tasks.report.html import (
    LOOK,
    WELL,
    Link,
    Section,
    bullets,
    document,
    nothing,
    paragraph,
    section,
    table,
    text,
    tiles,
)
from epipole.tasks.report.night_facts import (
    LeftOut,
    Look,
    NightFacts,
    PagePicture,
    ReportExtract,
    needs_look,
    percent,
)
from epipole.tasks.report.object_sections import epipolar, globe, objects, sky, trend
from epipole.tasks.report.sensor_sections import (
    attitudes,
    coverage,
    image_residuals,
    sigmas,
    star_map,
)

# The page: its head, and all sections in order.

MAX_LOOKS = 12
HELP = (
    "Point at a dot of a picture to see what it is; a click leads to its object. By keyboard: the "
    "arrows go from dot to dot, Enter follows, + and - zoom, Shift with arrows moves or turns, "
    "0 shows all."
)
MAX_LOGS = 50
LARGEST_PAGE = 1_450_000  # bytes: below the 1.5 MB that docs/report.md promises
MOST_THINNED = 64  # observations, of which one is drawn
MAX_SENSORS = 8  # that one line names
LONGEST_NAME = 40


def night_page(facts: NightFacts) -> str:
    """Return the report of a night as HTML: one file that needs no other.

    Where it would be longer than `LARGEST_PAGE`, fewer observations of its objects are drawn.
    """
    before = [counts(facts), coverage(facts), sigmas(facts), attitudes(facts), star_map(facts),
              image_residuals(facts), sky(facts), globe(facts), epipolar(facts)]  # fmt: skip
    after = [trend(facts), logs(facts)]
    every = 1
    while True:
        details = [each.thinned(every) for each in facts.details]
        page = _page(facts, [*before, objects(facts._replace(details=details)), *after])
        if len(page.encode()) <= LARGEST_PAGE or every >= MOST_THINNED:
            return page
        every *= 2


def _page(facts: NightFacts, sections: Sequence[Section]) -> str:
    looks = needs_look(facts)
    return document(
        f"Night {facts.night}",
        verdict=f"{LOOK} {len(looks)}" if looks else WELL,
        head=_head(facts, looks),
        contents="".join(f'<li><a href="#{s.anchor}">{text(s.title)}</a></li>\n' for s in sections),
        sections="".join(map(section, sections)),
    )


def _head(facts: NightFacts, looks: Sequence[Look]) -> str:
    about = (
        f"{facts.dataset} · {_many(len(facts.sources), 'log')} · "
        f"{_many(0 if facts.series is None else len(facts.series.sensors), 'sensor')} · "
        f"epipole {', '.join(sorted(set(facts.sources['code_version'])))}"
    )
    return (
        paragraph(about, "about")
        + paragraph(_in_short(facts))
        + _looks(looks)
        + paragraph(HELP, "help")
    )


def _in_short(facts: NightFacts) -> str:
    tonight = facts.trend[-1]
    return (
        f"{_many(tonight.frames, 'frame')}, {percent(tonight.identified_share)} identified by "
        "stars; "
        f"{_many(tonight.objects, 'object')} with {_many(tonight.positions, 'position')}."
    )


def _looks(looks: Sequence[Look]) -> str:
    if not looks:
        return '<div class="well"><h2>Nothing needs a look.</h2></div>\n'
    shown: list[Link | str] = [Link(*look) for look in looks[:MAX_LOOKS]]
    if len(looks) > len(shown):
        shown.append(f"And {len(looks) - len(shown)} more; the sections below have them.")
    return f'<div class="look"><h2>Needs a look</h2>\n{bullets(shown)}</div>\n'


def counts(facts: NightFacts) -> Section:
    """Return the section with counts, and with what was left out."""
    numbers = [(name, f"{count:,}") for name, count in facts.counts.items()]
    numbers.append(("objects", f"{len(facts.objects):,}"))
    body = tiles(numbers) + _left_out(facts)
    return Section("counts", "Counts, and what was left out", body)


def _left_out(facts: NightFacts) -> str:
    if not facts.left_out:
        return nothing("Nothing was left out.")
    by_reason: dict[tuple[str, str], list[LeftOut]] = {}
    for row in facts.left_out:
        by_reason.setdefault((row.stage, row.reason), []).append(row)
    rows = [
        (stage, reason, f"{sum(row.number for row in of_reason):,}", _sensors(of_reason),
         of_reason[0].sentence)
        for (stage, reason), of_reason in by_reason.items()
    ]  # fmt: skip
    caption = f"Left out: {sum(row.number for row in facts.left_out):,}"
    return table(caption, ("stage", "reason", "count", "of sensor", "meaning"), rows)


def _sensors(rows: Sequence[LeftOut]) -> str:
    shown = [
        f"{as_line(row.sensor_id, LONGEST_NAME) or 'no sensor'} {row.number:,}"
        for row in rows[:MAX_SENSORS]
    ]
    more = len(rows) - len(shown)
    return ", ".join(shown) + (f" and {more} more" if more else "")


def logs(facts: NightFacts) -> Section:
    """Return the section about the logs and the settings."""
    rows = [
        (name, f"{size / 1e6:,.2f}")
        for name, size in facts.sources.select("name", "size").head(MAX_LOGS).iter_rows()
    ]
    if not rows:
        return Section("logs", "Logs", nothing("No log is recorded for the night."))
    caption = "Logs of the night"
    if len(facts.sources) > len(rows):
        caption += f", {len(rows)} of {len(facts.sources):,}"
    keys = ", ".join(sorted(set(facts.sources["settings_key"])))
    return Section("logs", "Logs", table(caption, ("log", "MB"), rows)
                   + paragraph(f"Digest of the settings: {keys}"))  # fmt: skip


def _many(count: int, what: str) -> str:
    return f"{count:,} {what}" + ("" if count == 1 else "s")


# The extract.

PICTURE_IN = 2.6
LARGEST = 45_000  # bytes of one picture


def report_extract(facts: NightFacts) -> ReportExtract:
    """Return the pictures of coverage, sigmas and objects, and the gaps."""
    drawn = [(alt, as_png(draw, height)) for alt, draw, height in _pictures(facts)]
    pictures = tuple(PagePicture(alt, png) for alt, png in drawn if len(png) < LARGEST)
    series = facts.series
    lost = {} if series is None else dict(zip(series.sensors, series.lost_s.tolist(), strict=True))
    gaps = () if series is None else tuple(series.gaps)
    return ReportExtract(facts.night, pictures, gaps, {k: v for k, v in lost.items() if v})


def _pictures(facts: NightFacts) -> list[tuple[str, Draw, float]]:
    found: list[tuple[str, Draw, float]] = []
    if facts.series is not None:
        draw = partial(draw_coverage, series=facts.series)
        found.append(("Coverage of the sensors", draw, coverage_height(facts.series)))
    if facts.residuals is not None and facts.residuals.counts.sum():
        draw = partial(draw_normal, residuals=facts.residuals)
        found.append(("Star residuals against their sigma", draw, PICTURE_IN))
    if facts.chi2.pairs is not None:
        draw = partial(draw_half_normal, pairs=facts.chi2.pairs)
        found.append(("Pair distances against their sigma", draw, PICTURE_IN))
    ring = [each for each in facts.objects if each.near_geostationary]
    bound = [each for each in facts.objects if each.has_orbit and not each.near_geostationary]
    if ring:
        draw = partial(draw_ring, objects=ring, anchors={})
        found.append(("Objects in longitude and latitude", draw, PICTURE_IN))
    if bound:
        draw = partial(draw_elements, objects=bound, anchors={})
        found.append(("Objects by their elements", draw, 3.2))
    return found

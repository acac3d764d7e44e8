"""The extract of a report for Prefect's page."""

from functools import partial

from epipole.tasks.report.drawing.canvas import Draw, as_png
from epipole.tasks.report.drawing.distributions import draw_half_normal, draw_normal
from epipole.tasks.report.drawing.sensor_series import coverage_height, draw_coverage
from epipole.tasks.report.drawing.sky import draw_elements, draw_ring
from epipole.tasks.report.night_facts import NightFacts
from epipole.tasks.report.report_extract import PagePicture, ReportExtract

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
        draw = partial(draw_ring, objects=ring)
        found.append(("Objects in longitude and latitude", draw, PICTURE_IN))
    if bound:
        draw = partial(draw_elements, objects=bound)
        found.append(("Objects by their elements", draw, 3.2))
    return found

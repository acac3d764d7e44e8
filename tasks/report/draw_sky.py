"""Pictures of the sky and of distributions: tracklets, objects; found against expected."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import gammainc

from epipole.schemas.rejects import NameStatus, Outcome
from epipole.tasks.report.canvas import (
    BLACK,
    BLUE,
    GREEN,
    GREY,
    INK,
    LINES,
    ORANGE,
    PURPLE,
    SKY,
    VERMILLION,
    axes_of,
    hover,
    legend_below,
    zoomable,
)
from epipole.tasks.report.draw_sensors import night_axis
from epipole.tasks.report.objects import NightNumbers, NightObject, SkyTracks
from epipole.tasks.report.solved_chi2 import Chi2
from epipole.tasks.report.stars import HISTOGRAM, StarResiduals

# The sky.

Array = npt.NDArray[Any]

_OUTCOMES = {
    Outcome.OBJECT: (BLUE, "-", "o"),
    Outcome.LINKED: (SKY, "-", "P"),
    Outcome.SEEN_BY_ONE: (ORANGE, "--", "s"),
    Outcome.AMBIGUOUS: (PURPLE, "-.", "D"),
    Outcome.UNDECIDED: (GREEN, "-.", "p"),
    Outcome.DISAGREES: (VERMILLION, ":", "v"),
    Outcome.SENSOR_LEFT_OUT: (BLACK, ":", "X"),
    Outcome.NOT_COMPARED: (GREY, "--", "^"),
}
_STATUSES = {
    NameStatus.KNOWN: (BLUE, "o"),
    NameStatus.AMBIGUOUS: (ORANGE, "s"),
    NameStatus.UNKNOWN: (VERMILLION, "^"),
}
FAR_KM = 20_000.0


def draw_sky(figure: Figure, tracks: SkyTracks, anchors: Mapping[str, str]) -> None:
    """Draw tracklets in right ascension and declination, with a marker at their end.

    `anchors` are links to the objects on the page, by id.
    """
    axes = axes_of(figure, "right ascension [deg]", "declination [deg]")
    zoomable(axes, "ra")
    radec_deg = np.concatenate([line.radec_deg for line in tracks.lines])
    middle = np.radians(radec_deg[:, 0])
    centre = np.degrees(np.arctan2(np.sin(middle).mean(), np.cos(middle).mean())) % 360
    for outcome, (colour, dashes, marker) in _OUTCOMES.items():
        of_outcome = [line for line in tracks.lines if line.outcome == outcome]
        if not of_outcome:
            continue
        lines = [_unwrapped(line.radec_deg, centre) for line in of_outcome]
        x, y = np.concatenate([np.vstack([line, [np.nan, np.nan]]) for line in lines]).T
        axes.plot(x, y, color=colour, linestyle=dashes, linewidth=0.9)
        ends = np.array([line[-1] for line in lines])
        (dots,) = axes.plot(*ends.T, color=colour, linestyle="", marker=marker, markersize=3.2,
                            label=f"{outcome} ({tracks.counts.get(outcome, 0):,})")  # fmt: skip
        hover(dots, [line.about for line in of_outcome],
              [anchors.get(line.object_id, "") for line in of_outcome])  # fmt: skip
    _limits(axes, radec_deg, centre)
    legend_below(figure, axes, columns=2)


def _unwrapped(radec: Array, centre: float) -> Array:
    """Return a line (n, 2) [deg] with right ascensions near the centre, without jumps of 360."""
    ra = (radec[:, 0] - centre + 180.0) % 360.0 - 180.0 + centre
    ra = np.where(ra - ra[0] > 180, ra - 360, np.where(ra - ra[0] < -180, ra + 360, ra))
    return np.stack([ra, radec[:, 1]], axis=1)


def _limits(axes: Axes, radec_deg: Array, centre: float) -> None:
    ra = (radec_deg[:, 0] - centre + 180.0) % 360.0 - 180.0 + centre
    low, high = ra.min(), ra.max()
    margin = max(0.04 * (high - low), 0.05)
    axes.set_xlim(high + margin, low - margin)  # east is left, as seen from inside the sphere
    axes.locator_params(axis="x", nbins=6)
    axes.set_xticks(ticks := axes.get_xticks(), [f"{tick % 360:g}" for tick in ticks])
    axes.set_xlim(high + margin, low - margin)


def draw_ring(figure: Figure, objects: Sequence[NightObject], anchors: Mapping[str, str]) -> None:
    """Draw objects near the geostationary ring: longitude and latitude, first to last position."""
    axes = axes_of(figure, "longitude [deg east]", "latitude [deg]")
    for status, (colour, marker) in _STATUSES.items():
        of_status = [o for o in objects if o.status == status and o.ends is not None]
        if not of_status:
            continue
        first, last = np.array([o.ends for o in of_status])[:, :, :2].swapaxes(0, 1)
        jump = np.abs(first[:, 0] - last[:, 0]) > 180
        first[jump] = last[jump]
        axes.plot(*np.stack([first, last]).transpose(2, 0, 1), color=colour, linewidth=0.9)
        (dots,) = axes.plot(
            *last.T, **_mark(marker, colour), label=f"{status} ({len(of_status):,})"
        )
        hover(dots, [o.about for o in of_status],
              [anchors.get(o.object_id, "") for o in of_status])  # fmt: skip
    zoomable(axes)
    axes.locator_params(axis="x", nbins=5)  # more would run into each other
    axes.grid(color="#e3e7ea", linewidth=0.5)
    axes.set_axisbelow(True)
    legend_below(figure, axes, columns=3)


def _mark(marker: str, colour: str) -> dict[str, Any]:
    return {"linestyle": "", "marker": marker, "markersize": 4.5, "markerfacecolor": "none",
            "markeredgecolor": colour, "markeredgewidth": 1.2}  # fmt: skip


def draw_elements(
    figure: Figure, objects: Sequence[NightObject], anchors: Mapping[str, str]
) -> None:
    """Draw eccentricity and inclination of objects over their semi-major axis."""
    upper, lower = figure.subplots(2, 1, sharex=True)
    for status, (colour, marker) in _STATUSES.items():
        of_status = [o for o in objects if o.status == status and o.elements is not None]
        if not of_status:
            continue
        a, e, i = np.array([o.elements for o in of_status]).T
        sigmas = np.array([o.element_sigmas for o in of_status]).T
        for axes, y, sigma in ((upper, e, sigmas[1]), (lower, i, sigmas[2])):
            axes.errorbar(a, y, sigma, sigmas[0], fmt="none", ecolor=colour, elinewidth=0.5)
        label = f"{status} ({len(of_status):,})"
        for axes, y in ((upper, e), (lower, i)):
            (dots,) = axes.plot(a, y, **_mark(marker, colour), label=label)
            hover(dots, [o.about for o in of_status],
                  [anchors.get(o.object_id, "") for o in of_status])  # fmt: skip
    upper.set(ylabel="eccentricity")
    lower.set(ylabel="inclination [deg]", xlabel="semi-major axis [thousand km]")
    a, e, i = np.array([o.elements for o in objects if o.elements is not None]).T
    for axes, y in ((upper, e), (lower, i)):  # bars may leave the picture, dots may not
        _around(axes.set_xlim, a)
        _around(axes.set_ylim, y)
    upper.set_ylim(bottom=0)
    lower.xaxis.set_major_formatter(lambda value, _: f"{value / 1000:g}")
    lower.locator_params(axis="x", nbins=6)
    for axes in (upper, lower):
        axes.grid(color="#e3e7ea", linewidth=0.5)
        axes.set_axisbelow(True)
    legend_below(figure, upper, columns=3)


def _around(set_limits: Callable[[float, float], object], values: Array) -> None:
    margin = 0.08 * (values.max() - values.min()) + 1e-3 * abs(values.max()) + 1e-6
    set_limits(values.min() - margin, values.max() + margin)


def draw_trend(figure: Figure, nights: Sequence[NightNumbers]) -> None:
    """Draw a strip of each number over the nights; the last night has the large marker."""
    strips: tuple[tuple[str, list[float]], ...] = (
        ("identified\n[%]", [100 * each.identified_share for each in nights]),
        ("frames", [each.frames for each in nights]),
        ("objects", [each.objects for each in nights]),
        ("positions", [each.positions for each in nights]),
        ("left out", [each.rejects for each in nights]),
    )
    at = np.arange(len(nights))
    all_axes = figure.subplots(len(strips), 1, sharex=True)
    for (name, values), axes, (colour, marker, _) in zip(strips, all_axes, LINES, strict=False):
        axes.plot(at, values, color=colour, linewidth=1.0, marker=marker, markersize=2.8)
        dots = axes.scatter(at, values, s=30, alpha=0)
        hover(dots, [f"{each.night}: {' '.join(name.split())} {value:,.4g}"
                     for each, value in zip(nights, values, strict=True)])  # fmt: skip
        axes.plot(at[-1:], values[-1:], color=colour, marker=marker, markersize=7)
        axes.set_ylabel(name, rotation=0, ha="right", va="center")
        axes.set_ylim(0, 1.15 * max(max(values), 1e-9))
        axes.locator_params(axis="y", nbins=3)
        axes.yaxis.set_major_formatter(_number)
    night_axis(all_axes[-1], [each.night for each in nights])


def _number(value: float, _: object) -> str:
    if value >= 1e6:
        return f"{value / 1e6:g} M"
    return f"{value / 1e3:g} k" if value >= 1e4 else f"{value:g}"


# Distributions.

STEPS = 120  # of a curve
MAX_FREEDOMS = 200  # numbers of degrees of freedom whose distributions a curve sums
FOUND: dict[str, Any] = {"facecolor": SKY, "edgecolor": "white", "linewidth": 0.3}
EXPECTED: dict[str, Any] = {"color": INK, "linewidth": 1.4}


def draw_normal(figure: Figure, residuals: StarResiduals) -> None:
    """Draw the normalised star residuals of all sensors, and the standard normal."""
    counts = residuals.counts.sum(axis=0)
    axes = axes_of(figure, "star residual / its sigma", "density")
    _bars(axes, HISTOGRAM, counts)
    x = np.linspace(HISTOGRAM[0], HISTOGRAM[-1], STEPS)
    axes.plot(x, np.exp(-x * x / 2) / np.sqrt(2 * np.pi), label="standard normal", **EXPECTED)
    _finish(figure, axes, HISTOGRAM)


def draw_half_normal(figure: Figure, pairs: Chi2) -> None:
    """Draw the distances of pairs from their epipolar lines, and the half normal."""
    axes = axes_of(figure, "distance from the epipolar line / its sigma", "density")
    _bars(axes, pairs.edges, pairs.counts)
    x = np.linspace(0.0, pairs.edges[-1], STEPS)
    axes.plot(x, np.exp(-x * x / 2) * np.sqrt(2 / np.pi), label="half normal", **EXPECTED)
    _finish(figure, axes, pairs.edges)


def draw_chi2(figure: Figure, found: Chi2, what: str) -> None:
    """Draw chi-squares, and the sum of the distributions with their degrees of freedom.

    The line has steps, as the bars: the density of one degree of freedom is infinite at 0. A few
    values are drawn as dots, at the share of values below them, with the cumulative distribution.
    """
    axes = axes_of(figure, f"chi-square of {what}", "share below" if len(found.few) else "density")
    label = "chi-square distribution"
    if len(found.few):
        x = np.linspace(0.0, max(found.edges[-1], 1.05 * found.few[-1]), STEPS)
        axes.plot(x, _share_below(found, x), label=label, **EXPECTED)
        share = (np.arange(len(found.few)) + 0.5) / len(found.few)
        axes.plot(found.few, share, **_mark("o", BLUE), label="found")
        axes.set_ylim(0, 1.03)
        _finish(figure, axes, x)
        return
    _bars(axes, found.edges, found.counts)
    expected = np.diff(_share_below(found, found.edges))
    expected[-1] += 1 - expected.sum()  # as the last bar has all above it
    axes.stairs(expected / np.diff(found.edges), found.edges, label=label, **EXPECTED)
    _finish(figure, axes, found.edges)


def _share_below(found: Chi2, x: Array) -> Array:
    """Return the share of chi-squares that should be below each x."""
    kinds = np.flatnonzero(found.freedom)
    kinds = kinds[np.argsort(-found.freedom[kinds], kind="stable")][:MAX_FREEDOMS]
    weights = found.freedom[kinds] / found.freedom[kinds].sum()
    # scipy.stats takes a second to import.
    share: Array = gammainc(kinds / 2, np.asarray(x)[:, None] / 2) @ weights
    return share


def _bars(axes: Axes, edges: Array, counts: Array) -> None:
    density = counts / (counts.sum() * np.diff(edges))
    axes.bar(edges[:-1], density, np.diff(edges), align="edge", label="found", **FOUND)


def _finish(figure: Figure, axes: Axes, edges: Array) -> None:
    axes.set_xlim(edges[0], edges[-1])
    legend_below(figure, axes, columns=2)

"""Pictures of sensors over the night: frames, attitude sigmas, star residuals."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from epipole.tasks.report.drawing.canvas import (
    BLUE,
    LINES,
    ORANGE,
    PALE,
    VERMILLION,
    axes_of,
    legend_below,
    short,
    time_axis,
)
from epipole.tasks.report.frame_series import FrameSeries

Array = npt.NDArray[np.float64]

MOST_ROWS = 16
MOST_LINES = len(LINES)
ROW_IN = 0.3
MARKERS = 6  # on a line
# How frames got their attitude: colour, hatch, name.
KINDS = (
    (BLUE, "", "identified"), (ORANGE, "////", "predicted"), (VERMILLION, "xxxx", "no attitude"),
)  # fmt: skip


def coverage_height(series: FrameSeries) -> float:
    """Return how high the picture of the coverage is [in]."""
    return 0.95 + ROW_IN * min(len(series.sensors), MOST_ROWS)


def draw_coverage(figure: Figure, series: FrameSeries) -> None:
    """Draw a strip for each sensor: what its frames became, white where there are none."""
    axes = axes_of(figure)
    rows = worst_first(series)[:MOST_ROWS]
    edges = series.bins.edges_s
    for place, k in enumerate(rows):
        total = series.counts[:, k].sum(axis=0)
        usual = max(float(np.median(total[total > 0])), 1.0) if total.any() else 1.0
        bottom = np.full(len(total), place - 0.4)
        axes.add_patch(_frame(edges, place))
        for (colour, hatch, name), count in zip(KINDS, series.counts[:, k], strict=True):
            share = 0.8 * count / np.maximum(total, usual)
            if count.any():
                axes.stairs(bottom + share, edges, baseline=bottom, fill=True, facecolor=colour,
                            hatch=hatch, edgecolor="white" if hatch else colour,
                            linewidth=0.0, label=name)  # fmt: skip
            bottom = bottom + share
    axes.set_yticks(range(len(rows)), [short(series.sensors[k]) for k in rows])
    axes.tick_params(axis="y", length=0)
    axes.set(ylim=(-0.6, len(rows) - 0.4))
    axes.spines["left"].set_visible(False)
    time_axis(axes, edges[0], edges[-1])
    legend_below(figure, axes, columns=3)


def _frame(edges: Array, place: int) -> Rectangle:
    return Rectangle((edges[0], place - 0.4), edges[-1] - edges[0], 0.8, fill=False,
                     edgecolor=PALE, linewidth=0.6)  # fmt: skip


def worst_first(series: FrameSeries) -> list[int]:
    """Return the sensors: all in their order, or where they are too many, the worst ones first."""
    if len(series.sensors) <= MOST_ROWS:
        return list(range(len(series.sensors)))[::-1]
    order = np.lexsort((-series.lost_s, series.identified_share))
    return [int(k) for k in order]


def drawn_lines(series: FrameSeries) -> list[int]:
    """Return the sensors that have a line of their own: those with the largest residual."""
    if len(series.sensors) <= MOST_LINES:
        return list(range(len(series.sensors)))
    with np.errstate(invalid="ignore"):
        worst = np.nan_to_num(np.nanmax(np.nan_to_num(series.rms["residual"], nan=-1.0), axis=1))
    return sorted(np.argsort(-worst, kind="stable")[:MOST_LINES].tolist())


def draw_series(figure: Figure, series: FrameSeries, what: str, ylabel: str) -> None:
    """Draw a line per sensor of one of `SUMS` over time."""
    axes = axes_of(figure, ylabel=ylabel)
    edges = series.bins.edges_s
    middle = (edges[1:] + edges[:-1]) / 2
    values = series.rms[what]
    for number, k in enumerate(drawn_lines(series)):
        colour, marker, dashes = LINES[number % MOST_LINES]
        every = max(len(middle) // MARKERS, 1)
        axes.plot(middle, values[k], color=colour, marker=marker, linestyle=dashes, linewidth=1.0,
                  markersize=3.5, markevery=(number % every, every),
                  label=short(series.sensors[k], 12))  # fmt: skip
    time_axis(axes, edges[0], edges[-1])
    known = values[np.isfinite(values)]
    if len(known) and known.min() > 0 and known.max() / known.min() > 20:
        axes.set_yscale("log")
    elif len(known):
        axes.set_ylim(0, 1.12 * known.max())
    legend_below(figure, axes, columns=4)


def draw_focal_lengths(
    figure: Figure, nights: Sequence[str], ppm: dict[str, Sequence[float]]
) -> None:
    """Draw how much each sensor's focal length differs from its own median, by night [1e-6]."""
    axes = axes_of(figure, ylabel="focal length, from its median [ppm]")
    at = range(len(nights))
    for number, (name, values) in enumerate(ppm.items()):
        colour, marker, dashes = LINES[number % MOST_LINES]
        axes.plot(at, values, color=colour, marker=marker, linestyle=dashes, linewidth=1.0,
                  markersize=3.5, label=short(name, 12))  # fmt: skip
    night_axis(axes, nights)
    legend_below(figure, axes, columns=4)


def night_axis(axes: Axes, nights: Sequence[str]) -> None:
    """Make the x axis nights: as many dates as have room."""
    step = max(-(-len(nights) // 5), 1)
    at = list(range(len(nights) - 1, -1, -step))[::-1]
    axes.set_xticks(at, [nights[k][5:] for k in at])
    axes.set(xlim=(-0.5, len(nights) - 0.5), xlabel="night (month-day)")

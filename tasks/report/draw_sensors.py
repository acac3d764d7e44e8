"""Pictures of sensors: one frame, residuals, epipolar lines; and their night in curves."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from epipole.schemas.arrays import Array, Flags
from epipole.tasks.report.canvas import (
    BLACK,
    BLUE,
    GREY,
    LINES,
    ORANGE,
    PALE,
    SKY,
    VERMILLION,
    as_image,
    axes_of,
    hover,
    legend_below,
    short,
    time_axis,
    zoomable,
)
from epipole.tasks.report.epipolar_views import EpipolarViews
from epipole.tasks.report.frame_series import FrameSeries, clock
from epipole.tasks.report.stars import CELLS, StarMap, StarResiduals

# In the image of a sensor.


IMAGE_IN = 4.1  # height of a picture of an image
MAX_NAMES = 30
SAME_PX = 3.0  # a detection so near to an object at the epoch is that object
CROWD = 60  # objects: more have smaller marks
MIN_IN_CELL = 10
SURE_SIGMA = 4.0
VECTOR_SHARE = 0.06  # of the image's width: the length of a usual residual vector


def draw_star_map(figure: Figure, frame: StarMap, size_px: Array) -> None:
    """Draw a frame: stars with names and residual vectors, and detections that are no stars."""
    axes = axes_of(figure)
    x, y = frame.stars_px.T
    area = 3.0 + 2.5 * np.clip(frame.magnitude.max(initial=0.0) - frame.magnitude, 0, 12)
    stars = axes.scatter(x, y, s=area, color=BLACK, linewidths=0, zorder=3,
                         label="star, size by magnitude")  # fmt: skip
    hover(stars, frame.says)
    zoomable(axes)
    axes.scatter(x, y, s=area + 34, facecolors="none", edgecolors=BLUE, linewidths=0.9,
                 label="identified")  # fmt: skip
    scale = vector_scale(frame.residuals_px, size_px)
    _vectors(axes, frame.stars_px, frame.residuals_px, scale, VERMILLION)
    tracked, lone = frame.others_px[frame.objects], frame.others_px[~frame.objects]
    area, width = (26.0, 1.2) if len(tracked) <= CROWD else (9.0, 0.7)
    marks = axes.scatter(
        tracked[:, 0], tracked[:, 1], s=area, marker="s", facecolors="none", edgecolors=ORANGE,
        linewidths=width, label="object (has a track)",
    )  # fmt: skip
    hover(marks, [frame.others_say[k] for k in np.flatnonzero(frame.objects)])
    marks = axes.scatter(lone[:, 0], lone[:, 1], s=13, marker="x", color=GREY, linewidths=0.8,
                         label="other detection")  # fmt: skip
    hover(marks, [frame.others_say[k] for k in np.flatnonzero(~frame.objects)])
    for k, (dx, dy, how) in _label_positions(frame, size_px, scale).items():
        axes.annotate(str(frame.star_id[k]), frame.stars_px[k], (dx, dy), fontsize=6.5,
                      textcoords="offset points", ha=how, va="center", color=BLUE)  # fmt: skip
    as_image(axes, size_px)
    legend_below(figure, axes, columns=2)


def vector_scale(residuals_px: Array, size_px: Array) -> float:
    """Return how many times residual vectors are drawn longer: a round number."""
    length = np.hypot(*residuals_px.T)
    length = length[np.isfinite(length) & (length > 0)]
    if not len(length):
        return 1.0
    scale = VECTOR_SHARE * float(size_px[0]) / float(np.quantile(length, 0.75))
    power = 10.0 ** np.floor(np.log10(scale))
    return float(max(power * max(s for s in (1, 2, 5) if s * power <= scale), 1.0))


def _vectors(axes: Axes, points: Array, residuals: Array, scale: float, colour: str) -> None:
    if not len(points):
        return
    axes.quiver(*points.T, *(scale * residuals.T), angles="xy", scale_units="xy", scale=1.0,
                color=colour, width=0.006, headwidth=4, headlength=4.5, headaxislength=4,
                zorder=4)  # fmt: skip


def _label_positions(
    frame: StarMap, size_px: Array, scale: float
) -> dict[int, tuple[float, float, str]]:
    """Return offset [pt] and alignment of names where there is room, the brightest stars first."""
    wide, high = 0.12 * size_px[0], 0.03 * size_px[1]
    along = np.linspace(0.0, 1.0, 7)[:, None, None] * scale * frame.residuals_px
    arrows = np.nan_to_num(frame.stars_px + along).reshape(-1, 2)
    taken = [(x - high / 2, y, x + high / 2) for x, y in (*arrows, *frame.others_px)]
    found: dict[int, tuple[float, float, str]] = {}
    for k in np.argsort(frame.magnitude, kind="stable")[:MAX_NAMES].tolist():
        x, y = frame.stars_px[k]
        sides = (
            (6.0, 0.0, "left", x + high, y),
            (-6.0, 0.0, "right", x - high - wide, y),
            (0.0, 9.0, "center", x - wide / 2, y - 1.7 * high),
            (0.0, -9.0, "center", x - wide / 2, y + 1.7 * high),
        )
        for dx, dy, how, low, row in sides:
            up = low + wide
            free = all(abs(row - v) > high or up < a or low > b for a, v, b in taken)
            if free and low > 0 and up < size_px[0] and 0 < row < size_px[1]:
                taken.append((low, row, up))
                found[k] = (dx, dy, how)
                break
    return found


def draw_image_residuals(figure: Figure, residuals: StarResiduals, k: int) -> None:
    """Draw a sensor's mean star residual over its image; grey where chance alone explains it."""
    axes = axes_of(figure)
    size = residuals.size_px[k]
    centre = (np.arange(CELLS) + 0.5) / CELLS
    points = np.stack(np.meshgrid(centre * size[0], centre * size[1]), axis=-1).reshape(-1, 2)
    mean, surely = image_pattern(residuals, k)
    finite = np.isfinite(mean[:, 0])
    scale = vector_scale(mean[finite], size)
    axes.scatter(points[finite, 0], points[finite, 1], s=4, color=GREY, linewidths=0)
    for chosen, colour, name in ((finite & ~surely, SKY, "within the noise"),
                                  (finite & surely, VERMILLION, "above the noise")):  # fmt: skip
        _vectors(axes, points[chosen], mean[chosen], scale, colour)
        axes.plot([], [], color=colour, linewidth=1.5, marker=">", markersize=4, label=name)
    as_image(axes, size)
    axes.set_title(short(residuals.sensors[k]), fontsize=8.5)
    legend_below(figure, axes, columns=2)


def image_pattern(residuals: StarResiduals, k: int) -> tuple[Array, Flags]:
    """Return (cells, 2) mean residuals, NaN with few stars, and which are more than chance."""
    count = residuals.in_cell[k].ravel()
    mean = np.where(count[:, None] >= MIN_IN_CELL, residuals.mean_px[k].reshape(-1, 2), np.nan)
    sigma_px = residuals.sigma_px[k] / np.sqrt(np.maximum(count, 1))
    with np.errstate(invalid="ignore"):
        surely = np.hypot(*mean.T) > SURE_SIGMA * sigma_px
    return mean, surely


def draw_epipolar(figure: Figure, views: EpipolarViews, anchors: Mapping[str, str]) -> None:
    """Draw the lines of one sensor's lines of sight in the image of another.

    `anchors` are where on the page objects are shown more closely, by id.
    """
    axes = axes_of(figure)
    zoomable(axes)
    others = _other_than(views)
    if len(others):
        x, y = others.T
        axes.scatter(x, y, s=10, marker="x", color=GREY, linewidths=0.7,
                     label="other detections")  # fmt: skip
    ends: list[float] = []
    for number, line in enumerate(views.lines):
        colour, _, dashes = LINES[number % len(LINES)]
        names = {"line": f"line of sight of {short(views.from_sensor, 12)}",
                 "seen": f"object, seen by {short(views.in_sensor, 12)}"}  # fmt: skip
        axes.plot(*line.line_px.T, color=colour, linestyle=dashes, linewidth=1.0,
                  label=None if number else names["line"])  # fmt: skip
        (ring,) = axes.plot(
            *line.seen_px, marker="o", markersize=6, markerfacecolor="none", linestyle="",
            markeredgecolor=colour, markeredgewidth=1.3, label=None if number else names["seen"],
        )  # fmt: skip
        hover(ring, [f"{number + 1}, {line.object_id}: seen by {views.in_sensor} at "
                     f"{clock(views.epoch_ns)}, {line.distance_px:.2f} px from its line"],
              [anchors.get(line.object_id, "")])  # fmt: skip
        numbers_px = [(line.seen_px, (5, 6)), *_line_end(line.line_px, ends, views.size_px)]
        for at, offset in numbers_px:
            axes.annotate(f"{number + 1}", (at[0], at[1]), offset, textcoords="offset points",
                          fontsize=7, va="center", color=colour,
                          annotation_clip=False)  # fmt: skip
    as_image(axes, views.size_px)
    legend_below(figure, axes, columns=2)


def _line_end(
    line_px: Array, taken: list[float], size_px: Array
) -> list[tuple[Array, tuple[int, int]]]:
    """Return where the number of a line stands: beyond its right end, where there is room.

    `taken` are the rows of those that stand there.
    """
    if not len(line_px):
        return []
    end = line_px[np.argmax(line_px[:, 0])]
    if any(abs(end[1] - row) < 0.03 * size_px[1] for row in taken):
        return []
    taken.append(float(end[1]))
    return [(end, (10, 0))]


def _other_than(views: EpipolarViews) -> Array:
    """Return the detections that are none of the objects with a line."""
    seen = np.array([line.seen_px for line in views.lines]).reshape(-1, 2)
    apart = np.linalg.norm(views.others_px[:, None] - seen, axis=2)
    return views.others_px[(apart > SAME_PX).all(axis=1)]


# Over the night: frames, attitude sigmas, star residuals.

MAX_ROWS = 16
MAX_LINES = len(LINES)
ROW_IN = 0.3
MARKERS = 6  # on a line
MAX_HOVERED = 48  # bins of a line that say what they are
# How frames got their attitude: colour, hatch, name.
KINDS = (
    (BLUE, "", "identified"), (ORANGE, "////", "predicted"), (VERMILLION, "xxxx", "no attitude"),
)  # fmt: skip


def coverage_height(series: FrameSeries) -> float:
    """Return how high the picture of the coverage is [in]."""
    return 0.95 + ROW_IN * min(len(series.sensors), MAX_ROWS)


def draw_coverage(figure: Figure, series: FrameSeries) -> None:
    """Draw a strip for each sensor: what its frames became, white where there are none."""
    axes = axes_of(figure)
    rows = worst_first(series)[:MAX_ROWS]
    edges = series.bins.edges_s
    for row, k in enumerate(rows):
        total = series.counts[:, k].sum(axis=0)
        usual = max(float(np.median(total[total > 0])), 1.0) if total.any() else 1.0
        bottom = np.full(len(total), row - 0.4)
        axes.add_patch(_frame(edges, row))
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


def _frame(edges: Array, row: int) -> Rectangle:
    return Rectangle((edges[0], row - 0.4), edges[-1] - edges[0], 0.8, fill=False,
                     edgecolor=PALE, linewidth=0.6)  # fmt: skip


def worst_first(series: FrameSeries) -> list[int]:
    """Return the sensors: all in their order, or where they are too many, the worst ones first."""
    if len(series.sensors) <= MAX_ROWS:
        return list(range(len(series.sensors)))[::-1]
    order = np.lexsort((-series.lost_s, series.identified_share))
    return [int(k) for k in order]


def drawn_lines(series: FrameSeries) -> list[int]:
    """Return the sensors that get a line: those with the largest residual."""
    if len(series.sensors) <= MAX_LINES:
        return list(range(len(series.sensors)))
    with np.errstate(invalid="ignore"):
        worst = np.nan_to_num(np.nanmax(np.nan_to_num(series.rms["residual"], nan=-1.0), axis=1))
    return sorted(np.argsort(-worst, kind="stable")[:MAX_LINES].tolist())


def draw_series(figure: Figure, series: FrameSeries, what: str, ylabel: str) -> None:
    """Draw a line per sensor of one of `SUMS` over time."""
    axes = axes_of(figure, ylabel=ylabel)
    edges = series.bins.edges_s
    middle = (edges[1:] + edges[:-1]) / 2
    values = series.rms[what]
    for number, k in enumerate(drawn_lines(series)):
        colour, marker, dashes = LINES[number % MAX_LINES]
        every = max(len(middle) // MARKERS, 1)
        axes.plot(middle, values[k], color=colour, marker=marker, linestyle=dashes, linewidth=1.0,
                  markersize=3.5, markevery=(number % every, every),
                  label=short(series.sensors[k], 12))  # fmt: skip
        shown = np.flatnonzero(np.isfinite(values[k]))[:: -(-len(middle) // MAX_HOVERED)]
        dots = axes.scatter(middle[shown], values[k][shown], s=30, alpha=0)
        hover(dots, [f"{series.sensors[k]} at {clock(int(middle[i] * 1e9))}: {values[k][i]:.3g}"
                     for i in shown])  # fmt: skip
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
    """Draw how much each sensor's focal length differs from its median, by night [1e-6]."""
    axes = axes_of(figure, ylabel="focal length, from its median [ppm]")
    at = range(len(nights))
    for number, (name, values) in enumerate(ppm.items()):
        colour, marker, dashes = LINES[number % MAX_LINES]
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

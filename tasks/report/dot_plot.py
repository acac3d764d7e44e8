"""Dots over time as SVG, written directly: an object has two pictures, and matplotlib is slow.

A picture has the parts and classes that those of `canvas` have, so page.js treats both alike. What
its texts and lines look like stands in page.html.
"""

from collections.abc import Sequence
from typing import NamedTuple
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from epipole.schemas.arrays import Array
from epipole.schemas.text import as_line
from epipole.tasks.report.canvas import COLOURS, LINES, LONGEST_TEXT, clock_ticks, short

WIDTH, HEIGHT = 266.0, 150.0  # [pt], as wide as the other pictures
LEFT, RIGHT, TOP, BOTTOM = 34.0, 6.0, 6.0, 40.0  # margins
MARKS = 4  # kinds of dots, which page.html defines: they differ for those who see no colours
STEPS = 4  # of the y axis, about
LEGEND_PT = 56.0  # a name in the legend


class Dots(NamedTuple):
    """Dots of one name: times [s of the day], values, their sigmas (NaN: none), and texts."""

    name: str
    x_s: Array
    y: Array
    sigma: Array
    texts: Sequence[str]


def draw_dots(
    groups: Sequence[Dots], ylabel: str, down: bool = False, level: float | None = None
) -> str:
    """Return a picture of dots over time; '' without dots.

    Parameters
    ----------
    down
        Whether values grow downwards, as magnitudes do.
    level
        A line at this value.
    """
    x = np.concatenate([np.empty(0), *(group.x_s for group in groups)])
    y = np.concatenate([np.empty(0), *(group.y for group in groups)])
    if not len(x):
        return ""
    across, up = _range(x), _range(y if level is None else np.append(y, level))
    top, bottom = up if down else up[::-1]
    box = (LEFT, TOP, WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM)
    scale = _Scale(box, across, (top, bottom))
    parts = [_axes(scale, ylabel)]
    if level is not None:
        parts.append(
            f'<g class="data"><path d="M{box[0]} {scale.row(level):.1f}h{box[2]}" '
            f'style="fill: none; stroke: var(--grey); stroke-dasharray: 4 3"/></g>'
        )
    parts += [_dots(scale, group, k) for k, group in enumerate(groups)]
    parts += [_legend(group.name, k) for k, group in enumerate(groups)]
    sides = f'data-x="{across[0]:.9g} {across[1]:.9g}" data-y="{top:.6g} {bottom:.6g}"'
    return (
        f'<svg viewBox="0 0 {WIDTH:g} {HEIGHT:g}" xmlns="http://www.w3.org/2000/svg" '
        f'data-box="{box[0]:g} {box[1]:g} {box[2]:g} {box[3]:g}" {sides} data-kind="time">'
        f'<g class="dots">{"".join(parts)}</g></svg>'
    )


class _Scale(NamedTuple):
    """Where values are in the picture."""

    box: tuple[float, float, float, float]
    across: tuple[float, float]
    along: tuple[float, float]  # at the top, at the bottom

    def column(self, x: float) -> float:
        return self.box[0] + (x - self.across[0]) / (self.across[1] - self.across[0]) * self.box[2]

    def row(self, y: float) -> float:
        return self.box[1] + (y - self.along[0]) / (self.along[1] - self.along[0]) * self.box[3]


def _range(values: Array) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    margin = 0.06 * (high - low) or 0.5
    return low - margin, high + margin


def _axes(scale: _Scale, ylabel: str) -> str:
    left, top, width, height = scale.box
    floor = top + height
    ticks, labels = clock_ticks(*scale.across)
    columns = [scale.column(tick) for tick in ticks]
    first = "".join(_tick(x, floor, "v3", x, floor + 11, text)
                    for x, text in zip(columns, labels, strict=True))  # fmt: skip
    values = _round_values(*sorted(scale.along))
    second = "".join(_tick(left, y, "h-3", left - 5, y + 2.6, f"{value:g}")
                     for value in values for y in (scale.row(value),))  # fmt: skip
    middle = top + height / 2
    return (
        f'<path d="M{left} {top}V{floor}H{left + width}" '
        f'style="fill: none; stroke: var(--grey); stroke-width: 0.6"/>'
        f'<g class="xaxis">{first}{_text(left + width / 2, floor + 21, "time, UTC")}</g>'
        f'<g class="yaxis">{second}<text x="8" y="{middle:g}" transform="rotate(-90 8 {middle:g})" '
        f">{escape(ylabel)}</text></g>"
    )


def _tick(x: float, y: float, line: str, at_x: float, at_y: float, text: str) -> str:
    mark = f'<path d="M{x:.1f} {y:.1f}{line}"/>'
    return f'<g class="tick">{mark}{_text(at_x, at_y, text)}</g>'


def _text(x: float, y: float, text: str) -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}">{escape(text)}</text>'


def _round_values(low: float, high: float) -> list[float]:
    raw = (high - low) / STEPS
    power = 10.0 ** np.floor(np.log10(raw))
    step = power * next(s for s in (1, 2, 5, 10) if s * power >= raw * 0.999)
    first = int(np.ceil(low / step))
    return [round(k * step, 12) for k in range(first, int(np.floor(high / step)) + 1)]


def _dots(scale: _Scale, group: Dots, k: int) -> str:
    colour = f"var(--{COLOURS[LINES[k % len(LINES)][0]]})"
    bars, dots = [], []
    for x, y, sigma, text in zip(group.x_s, group.y, group.sigma, group.texts, strict=True):
        column, row = scale.column(float(x)), scale.row(float(y))
        if sigma == sigma:
            half = abs(scale.row(float(y + sigma)) - row)
            bars.append(f"M{column:.1f} {row - half:.1f}v{2 * half:.1f}")
        at = f'x="{column:.1f}" y="{row:.1f}"'
        dots.append(
            f'<use href="#mark{k % MARKS}" {at} data-t={quoteattr(as_line(text, LONGEST_TEXT))}/>'
        )
    line = (
        f'<path d="{"".join(bars)}" style="stroke: {colour}; stroke-width: 0.6"/>' if bars else ""
    )
    return f'<g class="data" style="fill: {colour}">{line}{"".join(dots)}</g>'


def _legend(name: str, k: int) -> str:
    number = int((WIDTH - LEFT) // LEGEND_PT)
    if k >= number:  # page.js shows the sensor of each dot
        return ""
    x, y = LEFT + k * LEGEND_PT, HEIGHT - 6
    colour = f"var(--{COLOURS[LINES[k % len(LINES)][0]]})"
    mark = f'<use href="#mark{k % MARKS}" x="{x:g}" y="{y:g}" style="fill: {colour}"/>'
    return f'<g class="named">{mark}{_text(x + 6, y + 2.6, short(name, 10))}</g>'

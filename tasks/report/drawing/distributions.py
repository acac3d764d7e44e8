"""Pictures of distributions: what was found beside what should be."""

from typing import Any

import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from scipy.special import gammaln

from epipole.tasks.report.drawing.canvas import INK, SKY, axes_of, legend_below
from epipole.tasks.report.solved_chi2 import Chi2
from epipole.tasks.report.star_residuals import HISTOGRAM, StarResiduals

Array = npt.NDArray[Any]

STEPS = 120  # of a curve
MOST_FREEDOMS = 200  # kinds of degrees of freedom that a curve is summed of
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
    """Draw chi-squares, and the sum of the chi-square distributions of their freedoms."""
    axes = axes_of(figure, f"chi-square of {what}", "density")
    _bars(axes, found.edges, found.counts)
    x = np.linspace(found.edges[0] + 1e-9, found.edges[-1], STEPS)
    kinds = np.flatnonzero(found.freedom)
    kinds = kinds[np.argsort(-found.freedom[kinds], kind="stable")][:MOST_FREEDOMS]
    weights = found.freedom[kinds] / found.freedom[kinds].sum()
    density = sum(w * _chi2_density(x, int(k)) for w, k in zip(weights, kinds, strict=True))
    axes.plot(x, density, label="chi-square distribution", **EXPECTED)
    widths = np.diff(found.edges)
    highest = (found.counts[1:-1] / (found.counts.sum() * widths[1:-1])).max(initial=0.0)
    axes.set_ylim(0, 1.25 * max(highest, float(density[STEPS // 12 :].max())))
    _finish(figure, axes, found.edges)


def _chi2_density(x: Array, freedom: int) -> Array:
    """Return the density of the chi-square distribution; scipy.stats takes a second to import."""
    half = freedom / 2
    return np.exp((half - 1) * np.log(x) - x / 2 - half * np.log(2) - gammaln(half))


def _bars(axes: Axes, edges: Array, counts: Array) -> None:
    density = counts / (counts.sum() * np.diff(edges))
    axes.bar(edges[:-1], density, np.diff(edges), align="edge", label="found", **FOUND)


def _finish(figure: Figure, axes: Axes, edges: Array) -> None:
    axes.set_xlim(edges[0], edges[-1])
    legend_below(figure, axes, columns=2)

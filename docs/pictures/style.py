"""How all pictures look, and how they are saved."""

import io
from pathlib import Path

import matplotlib as mpl
from PIL import Image

mpl.use("agg")
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, GREY = "#1f2933", "#8a949e"
BLUE, ORANGE, GREEN = "#1f6fb2", "#d9730d", "#2f8f5b"
TRACKS = (ORANGE, BLUE, GREEN, "#8a4fb0", "#c23b4a", "#2a9aa6", "#a8801c", "#5b6ad0", "#d65a9c")
DPI = 180

mpl.rcParams.update(
    {
        "font.family": "DejaVu Sans",
        "font.size": 8,
        "text.color": INK,
        "axes.edgecolor": GREY,
        "axes.labelcolor": INK,
        "axes.linewidth": 0.6,
        "axes.titlesize": 8.5,
        "axes.titlecolor": INK,
        "xtick.color": GREY,
        "ytick.color": GREY,
        "xtick.labelsize": 7,
        "ytick.labelsize": 7,
        "xtick.major.width": 0.6,
        "ytick.major.width": 0.6,
        "legend.frameon": False,
        "legend.fontsize": 7,
    }
)


def figure(width_in: float, height_in: float) -> tuple[Figure, Axes]:
    """Return a figure with one pair of axes."""
    return plt.subplots(figsize=(width_in, height_in), layout="constrained")


def image_axes(axes: Axes, width_px: int, height_px: int) -> None:
    """Make axes an image: rows go down, no numbers, square pixels."""
    axes.set(xlim=(-0.5, width_px - 0.5), ylim=(height_px - 0.5, -0.5), aspect="equal")
    axes.set(xticks=[], yticks=[])


def save(drawing: Figure, path: Path) -> None:
    """Write a small PNG: a palette of 200 colours is enough for lines and letters."""
    raw = io.BytesIO()
    drawing.savefig(raw, format="png", dpi=DPI, facecolor="white")
    plt.close(drawing)
    Image.open(raw).convert("RGB").quantize(200).save(path, optimize=True)

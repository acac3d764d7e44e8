"""How all pictures look, and how they become SVG or PNG.

matplotlib's objects are used without pyplot, which keeps a list of figures for the whole process.
Its options are of the process too: they are set only while a picture is drawn, by one thread.
"""

import contextlib
import logging
import re
import threading
import warnings
from collections.abc import Callable, Iterator
from io import BytesIO  # type: ignore[attr-defined]  # mypy takes the folder io/ for it
from typing import Any

import numpy as np
import numpy.typing as npt

from epipole.schemas.errors import ReportError
from epipole.schemas.text import as_line

# It warns of its font cache, which it makes once; nobody can do anything about it.
logging.getLogger("matplotlib").setLevel(logging.ERROR)
try:
    import matplotlib as mpl
    from matplotlib.axes import Axes
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine
except ImportError as error:
    raise ReportError(
        "the report needs matplotlib; python -m pip install 'epipole[report]'"
    ) from error

# Okabe and Ito (2008), Color Universal Design: distinct for people with any colour vision.
BLACK, ORANGE, SKY, GREEN = "#000000", "#E69F00", "#56B4E9", "#009E73"
YELLOW, BLUE, VERMILLION, PURPLE = "#F0E442", "#0072B2", "#D55E00", "#CC79A7"
INK, GREY, PALE = "#1f2933", "#66717c", "#d5dade"
# Lines differ by colour, marker and dashes.
LINES = (
    (BLUE, "o", "-"), (VERMILLION, "s", "--"), (GREEN, "^", "-."), (PURPLE, "D", ":"),
    (ORANGE, "v", "-"), (SKY, "P", "--"), (BLACK, "X", "-."), (GREY, "*", ":"),
)  # fmt: skip
WIDTH_IN = 3.7  # a phone is so wide: text in a picture is as large as beside it
LONGEST_NAME = 18
_OPTIONS: dict[Any, Any] = {
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.labelsize": 8,
    "axes.linewidth": 0.6,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.unicode_minus": True,
    "font.family": ["DejaVu Sans"],
    "font.size": 8,
    "hatch.linewidth": 0.5,
    "legend.fontsize": 7.5,
    "legend.frameon": False,
    "legend.handlelength": 1.8,
    "svg.fonttype": "none",  # text stays text: small, and as sharp as the reader's screen
    "svg.hashsalt": "epipole",  # else the names inside differ each time
    "text.color": INK,
    "text.parse_math": False,  # a name may have a $ in it
    "xtick.color": GREY,
    "xtick.labelcolor": INK,
    "xtick.labelsize": 7.5,
    "xtick.major.width": 0.6,
    "ytick.color": GREY,
    "ytick.labelcolor": INK,
    "ytick.labelsize": 7.5,
    "ytick.major.width": 0.6,
}
_NO_TIMES = {"Date": None, "Creator": None, "Format": None, "Type": None}
_ALONE = threading.Lock()
PNG_DPI = 110
_METADATA = re.compile(r"<metadata>.*?</metadata>\s*", re.DOTALL)
_LINE_START = re.compile(r"\n\s*")
_ATTRIBUTE = re.compile(r'="[^"]*"')
_LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}")  # a hundredth of a point is seen by nobody

Draw = Callable[[Figure], None]


def as_svg(draw: Draw, height_in: float, width_in: float = WIDTH_IN) -> str:
    """Return a picture as SVG, the same each time."""
    out: Any = BytesIO()
    with _drawn(draw, width_in, height_in) as figure:
        FigureCanvasSVG(figure).print_svg(out, metadata=_NO_TIMES)
    text: str = out.getvalue().decode()
    text = _METADATA.sub("", text[text.index("<svg") :])
    text = _ATTRIBUTE.sub(lambda match: _LONG_NUMBER.sub(_rounded, match[0]), text)
    text = _LINE_START.sub("\n", text)
    return text.replace("'DejaVu Sans'", "'DejaVu Sans', Verdana, sans-serif")


def as_png(draw: Draw, height_in: float, width_in: float = WIDTH_IN) -> bytes:
    """Return a picture as a small PNG, the same each time."""
    from PIL import Image  # comes with matplotlib

    out: Any = BytesIO()
    with _drawn(draw, width_in, height_in) as figure:
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        image = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
    image.quantize(64).save(out, "png", optimize=True)
    data: bytes = out.getvalue()
    return data


@contextlib.contextmanager
def _drawn(draw: Draw, width_in: float, height_in: float) -> Iterator[Figure]:
    """Yield a figure that is drawn, while matplotlib's options are those of this module.

    Its canvas is asked directly: `savefig` would draw all of it twice for its layout.
    """
    with _ALONE, mpl.rc_context(_OPTIONS), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of letters that the font does not have
        layout = ConstrainedLayoutEngine(w_pad=0.03, h_pad=0.03)
        figure = Figure(figsize=(width_in, height_in), dpi=PNG_DPI, layout=layout)
        draw(figure)
        yield figure


def _rounded(number: re.Match[str]) -> str:
    return f"{float(number[0]):.2f}"


def axes_of(figure: Figure, xlabel: str = "", ylabel: str = "") -> Axes:
    """Return the axes of a picture that has only these."""
    axes: Axes = figure.subplots()
    axes.set(xlabel=xlabel, ylabel=ylabel)
    return axes


def short(name: str, longest: int = LONGEST_NAME) -> str:
    """Return a name as it stands in a picture."""
    return as_line(name, longest)


def legend_below(figure: Figure, axes: Axes, columns: int = 3) -> None:
    """Put the legend of axes below the picture, where it hides nothing."""
    handles, labels = axes.get_legend_handles_labels()
    if handles:
        named = dict(zip(labels, handles, strict=True))
        figure.legend(named.values(), named.keys(), loc="outside lower center", ncols=columns,
                      columnspacing=1.2, handletextpad=0.5)  # fmt: skip


def as_image(axes: Axes, size_px: npt.NDArray[np.float64]) -> None:
    """Make axes an image: rows go down, square pixels."""
    margin = 0.02 * max(size_px)
    axes.set(xlim=(-margin, size_px[0] + margin), ylim=(size_px[1] + margin, -margin))
    axes.set(aspect="equal")
    axes.set(xlabel="column [px]", ylabel="row [px]")
    for side in ("top", "right"):
        axes.spines[side].set_visible(True)
    axes.locator_params(nbins=5)


# Steps between times that people read easily [s].
_STEPS = (1, 2, 5, 10, 15, 30, 60, 120, 300, 600, 900, 1800, 3600, 7200, 10800, 21600)
_DAY_S = 86_400


def time_axis(axes: Axes, first_s: float, last_s: float) -> None:
    """Make the x axis a clock, from seconds of the day."""
    length = max(last_s - first_s, 1.0)
    first_s, last_s = first_s - 0.01 * length, last_s + 0.01 * length
    step = next((s for s in _STEPS if length / s <= 4.5), _STEPS[-1])
    start = int(-(-first_s // step))
    ticks = [k * step for k in range(start, int(last_s // step) + 1)]
    axes.set_xticks(ticks, [_clock(t, with_seconds=step < 60) for t in ticks])
    axes.set(xlim=(first_s, last_s), xlabel="time, UTC")


def _clock(seconds: int, with_seconds: bool) -> str:
    seconds %= _DAY_S
    text = f"{seconds // 3600:02}:{seconds // 60 % 60:02}"
    return f"{text}:{seconds % 60:02}" if with_seconds else text

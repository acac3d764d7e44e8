"""How all pictures look, and how they become SVG or PNG.

matplotlib's objects are used without pyplot, which keeps a list of figures for the whole process.
Its options are global too: they are set only while a picture is drawn, by one thread at a time.
"""

import contextlib
import json
import logging
import re
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from io import BytesIO  # type: ignore[attr-defined]  # mypy takes the folder io/ for it
from typing import Any
from xml.etree import ElementTree

import numpy as np

from epipole.schemas.arrays import Array
from epipole.schemas.errors import ReportError
from epipole.schemas.text import as_line

# It warns of its font cache, which it makes once; nobody can do anything about it.
logging.getLogger("matplotlib").setLevel(logging.ERROR)
try:
    import matplotlib as mpl
    from matplotlib.artist import Artist
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
WIDTH_IN = 3.7  # of a phone: text in a picture is as large there as beside it
LONGEST_NAME, LONGEST_TEXT = 18, 300
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
_DRAWING = threading.Lock()
PNG_DPI = 110
_LONG_NUMBER = re.compile(r"-?\d+\.\d{3,}")  # nobody sees a hundredth of a point

Draw = Callable[[Figure], None]


def as_svg(draw: Draw, height_in: float, width_in: float = WIDTH_IN) -> str:
    """Return a picture as SVG, the same each time."""
    out: Any = BytesIO()
    with _drawn(draw, width_in, height_in) as figure:
        FigureCanvasSVG(figure).print_svg(out, metadata=_NO_TIMES)
    # matplotlib wrote it: it has no entities but those of XML.
    root = ElementTree.fromstring(out.getvalue())
    _for_page(root)
    zoomed = [axes for axes in figure.axes if (axes.get_gid() or "").startswith(_ZOOM)]
    if zoomed:
        _describe_axes(root, figure, zoomed[0])
    made: str = ElementTree.tostring(root, encoding="unicode")
    return made


# For page.js: text (`data-t`) and link (`data-h`) of each dot, classes of data and of axes, and the
# values at the sides of the axes.

SVG, XLINK = "http://www.w3.org/2000/svg", "http://www.w3.org/1999/xlink"
ElementTree.register_namespace("", SVG)
ElementTree.register_namespace("xlink", XLINK)
_HOVER, _ZOOM = "hover:", "zoom:"  # how the names of groups begin
_CLASSES = {"matplotlib.axis_1": "xaxis", "matplotlib.axis_2": "yaxis"}
_TICK = ("xtick_", "ytick_")
_DATA = ("PathCollection_", "LineCollection_", "line2d_", "Quiver_", "text_", "data", _HOVER)
_MARKS = ("PathCollection_", _HOVER)  # these keep their size when the page zooms
# Colours of a picture follow those of the page, dark or light.
COLOURS = {
    INK: "ink", GREY: "grey", PALE: "pale", "#e3e7ea": "grid", "#ffffff": "paper",
    BLACK: "black", ORANGE: "orange", SKY: "sky", GREEN: "green", YELLOW: "yellow", BLUE: "blue",
    VERMILLION: "vermillion", PURPLE: "purple",
}  # fmt: skip
_VARIABLES = {colour.lower(): f"var(--{name})" for colour, name in COLOURS.items()}
_COLOUR = re.compile(r"#[0-9a-f]{6}")
_FONT = re.compile(r"font-family: [^;]*; ?")  # removed: the page has its font


def hover(artist: Artist, texts: Sequence[str], links: Sequence[str] = ()) -> None:
    """Give each dot of an artist a text that the page shows beside it, and perhaps a link."""
    shown = [as_line(each, LONGEST_TEXT) for each in texts]
    artist.set_gid(_HOVER + json.dumps([shown, list(links)]))


def zoomable(axes: Axes, kind: str = "number") -> None:
    """Let the page zoom into these axes; `kind` of the x axis: number, ra (mod 360) or time."""
    axes.set_gid(_ZOOM + kind)


def _for_page(root: ElementTree.Element) -> None:
    """Prepare a picture for a page: remove ids and styles that could clash with those of others."""
    for parent in list(root.iter()):
        for child in list(parent):
            parent.text = parent.text and parent.text.strip()
            child.tail = None
            if child.tag in (f"{{{SVG}}}metadata", f"{{{SVG}}}style"):
                parent.remove(child)
        name = parent.get("id", "")
        if parent.tag == f"{{{SVG}}}g" and name:
            _name_group(parent, name)
        for key, value in parent.items():
            if key not in ("id", "data-t"):
                shorter = _FONT.sub("", _COLOUR.sub(_variable, value))
                parent.set(key, _LONG_NUMBER.sub(_rounded, shorter))
        if parent.get("transform", "").startswith("rotate(-0 "):
            del parent.attrib["transform"]
    for group in root.iter(f"{{{SVG}}}g"):
        _share_style(group)
    for key in ("width", "height", "version"):
        root.attrib.pop(key, None)


def _share_style(group: ElementTree.Element) -> None:
    """Move a style that all parts of a group have from the parts to the group."""
    styles = {child.get("style") for child in group if child.tag != f"{{{SVG}}}defs"}
    if len(styles) == 1 and len(group) > 1 and not group.get("style"):
        style = styles.pop()
        if style and "clip-path" not in style:
            group.set("style", style)
            for child in group:
                child.attrib.pop("style", None)


def _name_group(group: ElementTree.Element, name: str) -> None:
    """Replace a group's id, `name`, by a class, or by the texts and links of its dots."""
    del group.attrib["id"]
    if name in _CLASSES:
        group.set("class", _CLASSES[name])
    elif name.startswith(_TICK):
        group.set("class", "tick")
    elif name.startswith(_ZOOM):
        for child in group:
            if (kind := child.get("id", "")).startswith(_DATA):
                child.set("class", "data marks" if kind.startswith(_MARKS) else "data")
        group.set("class", "zoom")
    elif name.startswith(_HOVER):
        texts, links = json.loads(name.removeprefix(_HOVER))
        dots = [each for each in _outside_definitions(group) if _is_dot(each)]
        if len(dots) == len(texts):
            for k, dot in enumerate(dots):
                if texts[k]:
                    dot.set("data-t", texts[k])
                if links and links[k]:
                    dot.set("data-h", links[k])


def _outside_definitions(group: ElementTree.Element) -> Iterator[ElementTree.Element]:
    for child in group:
        if child.tag != f"{{{SVG}}}defs":
            yield child
            yield from _outside_definitions(child)


def _is_dot(element: ElementTree.Element) -> bool:
    return element.tag in (f"{{{SVG}}}use", f"{{{SVG}}}path")


def _variable(colour: re.Match[str]) -> str:
    return _VARIABLES.get(colour[0], colour[0])


def _describe_axes(root: ElementTree.Element, figure: Figure, axes: Axes) -> None:
    """Write to the root where the axes are [pt], and the values at their sides."""
    width, height = (72 * float(inches) for inches in figure.get_size_inches())
    at = axes.get_position()
    box = (at.x0 * width, (1 - at.y1) * height, at.width * width, at.height * height)
    (left, right), (bottom, top) = axes.get_xlim(), axes.get_ylim()
    for name, values in (("box", box), ("x", (left, right)), ("y", (top, bottom))):
        root.set(f"data-{name}", " ".join(f"{value:.6g}" for value in values))
    root.set("data-kind", str(axes.get_gid()).removeprefix(_ZOOM))


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
    """Yield a figure with its drawing, while matplotlib's options are those of this module.

    Write it by its canvas: `savefig` would draw all of it twice for its layout.
    """
    with _DRAWING, mpl.rc_context(_OPTIONS), warnings.catch_warnings():
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


def as_image(axes: Axes, size_px: Array) -> None:
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
    axes.set_xticks(*clock_ticks(first_s, last_s))
    axes.set(xlim=(first_s, last_s), xlabel="time, UTC")


def clock_ticks(first_s: float, last_s: float) -> tuple[list[int], list[str]]:
    """Return a few round times between two, in seconds of the day, and their labels."""
    length = max(last_s - first_s, 1.0)
    step = next((s for s in _STEPS if length / s <= 4.6), _STEPS[-1])
    start = int(-(-first_s // step))
    ticks = [k * step for k in range(start, int(last_s // step) + 1)]
    return ticks, [_clock(t, with_seconds=step < 60) for t in ticks]


def _clock(seconds: int, with_seconds: bool) -> str:
    seconds %= _DAY_S
    text = f"{seconds // 3600:02}:{seconds // 60 % 60:02}"
    return f"{text}:{seconds % 60:02}" if with_seconds else text

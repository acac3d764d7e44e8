"""The README's picture: the stages, the tables they pass on, and what three of them do."""

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import ConnectionPatch, FancyArrowPatch, FancyBboxPatch
from night import Night
from style import BLUE, GREEN, GREY, ORANGE, plt
from views import draw_ellipsoid, draw_frame, draw_meeting, draw_tracklets

from epipole.schemas.stages import Stage

WIDTH, HEIGHT = 9.0, 4.3  # inch, the unit of all places below
BOX_WIDTH, BOX_HEIGHT, PITCH, ROW = 0.80, 0.40, 1.025, 3.56
FIRST = 0.92  # the middle of the first box
# What a stage hands to the next one.
PASSED = {
    Stage.READ: "frames\nsensor states",
    Stage.IDENTIFY: "stars\ndetections",
    Stage.CALIBRATE: "optics",
    Stage.TRACK: "tracklets",
    Stage.SOLVE: "associations\npositions",
    Stage.CHECK: "sound\nsensors",
    Stage.NAME: "object_id",
}
PANEL_TOP, PANEL_BOTTOM = 2.86, 0.34


def draw_pipeline(night: Night) -> Figure:
    """Return the picture."""
    drawing = plt.figure(figsize=(WIDTH, HEIGHT))
    page = drawing.add_axes((0, 0, 1, 1))
    page.set(xlim=(0, WIDTH), ylim=(0, HEIGHT))
    page.axis("off")
    _draw_row(page)
    height = PANEL_TOP - PANEL_BOTTOM
    lefts, wide = (0.28, 3.02, 5.76), 2.96
    captions = {
        Stage.IDENTIFY: "identified stars give the attitude",
        Stage.TRACK: "a minute of all that is no star",
        Stage.SOLVE: "lines of sight meet in a point",
    }
    for left, (stage, caption) in zip(lefts, captions.items(), strict=True):
        _caption(page, left, stage, caption)
    draw_frame(_panel(drawing, lefts[0], PANEL_BOTTOM, height, height), night)
    draw_tracklets(_panel(drawing, lefts[1], PANEL_BOTTOM, height, height), night)
    part = (height - 0.16) / 2
    meeting = _panel(drawing, lefts[2], PANEL_TOP - part, wide, part)
    draw_meeting(meeting, night, part / wide)
    ellipsoid = _panel(drawing, lefts[2], PANEL_BOTTOM, wide, part)
    draw_ellipsoid(ellipsoid, night)
    _zoom(drawing, meeting, ellipsoid)
    return drawing


def _caption(page: Axes, left: float, stage: Stage, caption: str) -> None:
    name = page.text(left, 0.14, str(stage), va="center", fontsize=8, fontweight="bold", color=BLUE)
    page.annotate(
        caption, (1, 0), xycoords=name, xytext=(5, 0), textcoords="offset points", va="bottom",
        fontsize=8,
    )  # fmt: skip


def _zoom(drawing: Figure, meeting: Axes, ellipsoid: Axes) -> None:
    """Draw that the lower panel is the green point of the upper one."""
    (point,) = [line for line in meeting.lines if line.get_color() == GREEN]
    for corner in ((0, 1), (1, 1)):
        drawing.add_artist(
            ConnectionPatch(
                point.get_xydata()[0], corner, meeting.transData, ellipsoid.transAxes,
                color=GREY, linewidth=0.7, linestyle=":",
            )
        )  # fmt: skip


def _panel(drawing: Figure, left: float, bottom: float, width: float, height: float) -> Axes:
    return drawing.add_axes((left / WIDTH, bottom / HEIGHT, width / WIDTH, height / HEIGHT))


def _middle(stage: Stage) -> float:
    return FIRST + PITCH * list(Stage).index(stage)


def _draw_row(page: Axes) -> None:
    for stage in Stage:
        x = _middle(stage)
        page.add_patch(
            FancyBboxPatch(
                (x - BOX_WIDTH / 2, ROW - BOX_HEIGHT / 2),
                BOX_WIDTH,
                BOX_HEIGHT,
                boxstyle="round,pad=0,rounding_size=0.07",
                facecolor="#e8f1f9",
                edgecolor=BLUE,
                linewidth=1.0,
            )
        )
        page.text(x, ROW, str(stage), ha="center", va="center", fontsize=9)
    gap = PITCH - BOX_WIDTH
    for stage, tables in PASSED.items():
        edge = _middle(stage) + BOX_WIDTH / 2
        _arrow(page, (edge, ROW), (edge + gap, ROW))
        _label(page, edge + gap / 2, tables)
    left, right = FIRST - BOX_WIDTH / 2, _middle(Stage.PUBLISH) + BOX_WIDTH / 2
    _arrow(page, (left - 0.24, ROW), (left, ROW))
    _label(page, left - 0.12, "MCAP\nlogs")
    _arrow(page, (right, ROW), (right + 0.24, ROW))
    _label(page, right + 0.12, "Parquet")
    _draw_return(page)


def _label(page: Axes, x: float, words: str) -> None:
    """Write lines above the row; the last ones of all labels stand on one height."""
    for number, line in enumerate(reversed(words.split("\n"))):
        page.text(x, ROW + 0.29 + 0.13 * number, line, ha="center", fontsize=7.4)


def _draw_return(page: Axes) -> None:
    """Draw that `check` sends a night back to `track`."""
    bottom = ROW - BOX_HEIGHT / 2
    start, end = _middle(Stage.CHECK), _middle(Stage.TRACK)
    page.plot([start, start, end], [bottom, bottom - 0.22, bottom - 0.22], color=ORANGE, lw=1.0)
    _arrow(page, (end, bottom - 0.22), (end, bottom), ORANGE)
    page.text(
        (start + end) / 2, bottom - 0.25, "again, if a sensor is at fault",
        ha="center", va="top", fontsize=7.4, color=ORANGE,
    )  # fmt: skip


def _arrow(
    page: Axes, start: tuple[float, float], end: tuple[float, float], colour: str = GREY
) -> None:
    page.add_patch(
        FancyArrowPatch(
            start, end, arrowstyle="-|>", mutation_scale=8, linewidth=1.0, color=colour,
            shrinkA=0, shrinkB=0,
        )
    )  # fmt: skip

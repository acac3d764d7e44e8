"""Artifacts of a night on Prefect's page: its progress and its results.

A page that cannot be written is a warning, never an error.
"""

import base64
import contextlib
import logging
import time
from collections.abc import Iterator, Mapping
from typing import cast
from uuid import UUID

import httpx
from prefect.artifacts import (
    create_markdown_artifact,
    create_progress_artifact,
    create_table_artifact,
    update_progress_artifact,
)
from prefect.exceptions import PrefectException

from epipole.flows.night.progress import COMPILE
from epipole.flows.night.summary import Summary, many
from epipole.schemas.rejects import Reason
from epipole.schemas.text.shown import as_line, as_markdown_text
from epipole.tasks.report.report_extract import ReportExtract

LOGGER = logging.getLogger(__name__)

LONGEST_ID = 100
MOST_SENSORS = 50  # that the table of gaps names
UPDATED_EVERY_S = 3.0
_PAGE_ERRORS = (httpx.HTTPError, PrefectException, OSError, RuntimeError)


@contextlib.contextmanager
def _as_warning(what: str) -> Iterator[None]:
    try:
        yield
    except _PAGE_ERRORS as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        LOGGER.warning("%s could not be shown on Prefect's page: %s", what, reason)


class ProgressBar(logging.Handler):
    """A progress artifact that follows the steps of a run; see `epipole.flows.night.progress`."""

    def __init__(self) -> None:
        super().__init__()
        self._id: UUID | None = None
        self._next_s = 0.0
        self._percent = 0.0
        with _as_warning("progress"):
            self._id = cast(UUID, create_progress_artifact(0.0, "progress", "start"))

    def emit(self, record: logging.LogRecord) -> None:
        """Show a step, at most one every `UPDATED_EVERY_S`."""
        counts = vars(record)
        if self._id is None or time.monotonic() < self._next_s or counts["stage"] == COMPILE:
            return
        self._show(counts["percent"], f"{counts['stage']}: {counts['done']} of {counts['total']}")

    def finish(self, how: str) -> None:
        """Show how the run ended."""
        if self._id is not None:
            self._show(100.0, how)

    def _show(self, percent: float, description: str) -> None:
        self._percent = max(self._percent, percent)  # a stage may run twice
        artifact, self._id = self._id, None  # after an error it is not updated again
        with _as_warning("progress"):
            if artifact is not None:
                update_progress_artifact(artifact, self._percent, description)
            self._id = artifact
            self._next_s = time.monotonic() + UPDATED_EVERY_S


def show_summary(summary: Summary) -> None:
    """Show the results of a run: its counts and where its nights are, and a table of sensors."""
    nights = ", ".join(summary.nights)
    with _as_warning("the summary"):
        create_markdown_artifact(as_markdown(summary), "night", f"Night {nights}")
        rows = [
            sensor.as_row() | {"sensor": as_line(sensor.sensor_id, LONGEST_ID)}
            for sensor in summary.by_sensor
        ]
        create_table_artifact(rows, "sensors", f"Sensors of {nights}")


def as_markdown(summary: Summary) -> str:
    """Return the summary as a page of Markdown."""
    counts = {
        "logs": summary.logs,
        "frames": summary.frames,
        "identified by stars": summary.identified,
        "stars": summary.stars,
        "detections": summary.detections,
        "tracklets": summary.tracklets,
        "objects": summary.objects,
        "epochs": summary.epochs,
        "positions": summary.positions,
    } | {f"objects {status}": count for status, count in summary.names.items()}
    lines = [f"# Night {', '.join(summary.nights)}", "", *_table("what", counts), ""]
    if summary.unchanged:
        lines += ["Nothing has changed since it was made, so it was not made again.", ""]
    # No link: browsers open neither files nor buckets from a page.
    lines += ["Tables:", "", *(f"- {as_markdown_text(place)}" for place in _places(summary))]
    if summary.faults:
        lines += [
            "",
            "Sensors at fault:",
            "",
            *(f"- {as_markdown_text(fault)}" for fault in summary.faults),
        ]
    if summary.residuals:
        lines += ["", "Known objects, observed minus predicted:", ""]
        lines += [f"- {as_markdown_text(residual)}" for residual in summary.residuals]
    if summary.rejects:
        lines += ["", f"Left out: {many(sum(summary.rejects.values()), 'thing')}", ""]
        lines += _left_out(summary.rejects)
    for extract in summary.extracts:
        lines += _extract(extract)
    return "\n".join(lines) + "\n"


def _left_out(rejects: Mapping[str, int]) -> list[str]:
    rows = [
        f"| {reason} | {count:,} | {Reason(reason).sentence} |" for reason, count in rejects.items()
    ]
    return ["| reason | count | meaning |", "|---|---:|---|", *rows]


def _extract(extract: ReportExtract) -> list[str]:
    """Return a night's pictures, as data in their addresses, and its gaps by sensor."""
    lines = ["", f"## Report of {extract.night}"]
    for picture in extract.pictures:
        data = base64.b64encode(picture.png).decode()
        lines += ["", f"![{as_markdown_text(picture.alt)}](data:image/png;base64,{data})"]
    if extract.lost_s:
        lines += ["", "| sensor | gaps | seconds without frames |", "|---|---:|---:|"]
        for sensor, lost_s in list(extract.lost_s.items())[:MOST_SENSORS]:
            count = sum(gap.sensor_id == sensor for gap in extract.gaps)
            name = as_markdown_text(sensor, LONGEST_ID)
            lines.append(f"| {name} | {count:,} | {lost_s:,.0f} |")
    return lines


def _places(summary: Summary) -> list[str]:
    return [f"{summary.dataset.rstrip('/')}/night={night}" for night in summary.nights]


def _table(heading: str, counts: dict[str, int]) -> list[str]:
    rows = [f"| {key} | {count:,} |" for key, count in counts.items()]
    return [f"| {heading} | count |", "|---|---:|", *rows]

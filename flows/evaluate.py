"""Compare a dataset with the truth of a simulation, and report the result."""

import logging
import os
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pyarrow as pa
from rich.console import Console
from rich.table import Table

from epipole.io.datasets.dataset import nights_in, read_table
from epipole.io.datasets.rows_by_night import nights_of
from epipole.io.simulation.truth import Truth, read_truth
from epipole.schemas.bridge import from_polars, to_polars
from epipole.schemas.errors import DatasetError
from epipole.schemas.evaluation import Report
from epipole.schemas.spans import DAY_NS, day_of
from epipole.schemas.work_tables import TRUE_POINTS
from epipole.tasks.evaluate.evaluate_dataset import evaluate_dataset
from epipole.tasks.evaluate.matching import FRAME

LOGGER = logging.getLogger(__name__)

TABLES = (
    *("frames", "stars", "tracklets", "detections", "epochs", "associations"),
    *("positions", "observations", "states", "orbits", "identifications"),
)


def evaluate(dataset: str | os.PathLike[str], truth: str | os.PathLike[str]) -> Report:
    """Return the report of a dataset against the truth of the simulation it was made from.

    Parameters
    ----------
    dataset
        The folder or URL that `epipole run` published to. Only the nights of the truth are used.
    truth
        The folder ``LOG.truth``, or the log beside it. Only the nights of the dataset are used; a
        warning names the others.

    Raises
    ------
    DatasetError
        Where either is missing or cannot be read, or the dataset has no night of the truth.
    """
    true = read_truth(truth)
    dataset = os.fspath(dataset)
    nights = _nights(dataset, true)
    tables = {
        name: pa.concat_tables([read_table(dataset, name, night) for night in nights])
        for name in TABLES
    }
    return evaluate_dataset(tables, _truth_of(true, nights))


def _truth_of(truth: Truth, nights: Sequence[str]) -> Truth:
    """Return the truth of some nights."""
    days = np.asarray(truth.frames["t_ns"], np.int64) // DAY_NS
    frames = truth.frames.filter(np.isin(days, [day_of(night) for night in nights]))
    if len(frames) == len(days):
        return truth
    of_frames = to_polars(frames.select(FRAME))
    points = to_polars(truth.points).join(of_frames, on=FRAME, how="semi", maintain_order="left")
    return replace(truth, frames=frames, points=from_polars(TRUE_POINTS, points))


def _nights(dataset: str, truth: Truth) -> list[str]:
    published = nights_in(dataset)
    if not published:
        raise DatasetError(
            f"{dataset}: no dataset here; `epipole run LOG --out {dataset}` makes one"
        )
    wanted = nights_of(np.asarray(truth.frames["t_ns"], np.int64))
    nights = [night for night in wanted if night in published]
    if not nights:
        raise DatasetError(
            f"{dataset}: has no night={' or night='.join(wanted) or '...'} of this truth; "
            "give the truth of a log that the dataset was made from"
        )
    if without := [night for night in wanted if night not in nights]:
        LOGGER.warning("%s: has no %s: not evaluated", dataset, ", ".join(without))
    return nights


def show(report: Report, console: Console | None = None) -> None:
    """Print a report as a table."""
    table = Table(box=None, pad_edge=False, show_header=False)
    table.add_column(style="bold")
    table.add_column()
    table.add_column(justify="right")
    last = ""
    for group, label, value in report.rows():
        table.add_row("" if group == last else group, label, value)
        last = group
    (console or Console()).print(table)

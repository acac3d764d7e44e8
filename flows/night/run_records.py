"""Records of runs, beside the nights: how the last run of each night ended, what it took, metrics.

A night that failed, or had no frames, is not in the dataset; its record says so.
"""

import datetime
import logging
import platform
import resource
import socket
import time
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from importlib import metadata
from typing import Any, NamedTuple

import pyarrow as pa
import pyarrow.parquet as pq

from epipole.flows.night.summary import Summary
from epipole.io.datasets.dataset import night_row, nights_in, read_beside, read_table, write_beside
from epipole.io.datasets.local import RUNS as RUNS_FOLDER
from epipole.io.work.recipe import LIBRARIES
from epipole.schemas.bridge import table
from epipole.schemas.dates import MONTH, nights_before
from epipole.schemas.errors import DatasetError
from epipole.schemas.rejects import Reason
from epipole.schemas.run_record import RUNS, RunState
from epipole.schemas.settings import Settings

LOGGER = logging.getLogger(__name__)

METRICS = "last.prom"  # OpenMetrics, of the last run
COUNTED = ("sensors", "frames", "identified", "objects", "positions")  # of a night, as metrics
_BROKEN = {
    Reason.NO_MCAP.value: "is no MCAP file; it is on no night",
    Reason.NOTHING_READ.value: "has nothing that can be used; it is on no night",
}


class Stopwatch(NamedTuple):
    """What the process had used when a run began."""

    begun_s: float
    cpu_s: float

    @classmethod
    def start(cls) -> "Stopwatch":
        """Return what the process has used until now."""
        return cls(time.monotonic(), time.process_time())


def read_records(dataset: str, nights: Collection[str] | None = None) -> dict[str, dict[str, Any]]:
    """Return the record of each night that has one, or of some nights.

    Records that cannot be read are left out.
    """
    rows = read_beside(dataset, RUNS_FOLDER, RUNS, nights)
    return {row["night"]: row for row in rows}


def write_record(
    dataset: str,
    night: str,
    state: RunState,
    message: str,
    used: Stopwatch,
    settings: Settings,
    needs_look: Sequence[str] | None = None,
) -> bool:  # fmt: skip
    """Write the record of a night's run; return whether it says something new.

    A record that cannot be written is a warning. None for `needs_look`: the run has published
    nothing of the night, so what needed a look before still does.
    """
    row = {
        "night": night,
        "state": state.value,
        "message": message,
        "needs_look": list(needs_look or ()),
        "ended": int(time.time()) * 1_000_000_000,  # whole seconds: Python's datetime takes them
        "duration_s": time.monotonic() - used.begun_s,
        "cpu_s": time.process_time() - used.cpu_s,
        "memory_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "run_id": _run_id(),
        "host": socket.gethostname(),
        "versions": _versions(),
        "settings": settings.changed(),
    }
    try:
        before = read_records(dataset, [night]).get(night)
        if needs_look is None and before is not None:
            row["needs_look"] = before["needs_look"]
        counts = _counts(dataset, night) if state == RunState.MADE else {}
        file = pa.BufferOutputStream()
        pq.write_table(table(RUNS, {name: [value] for name, value in row.items()}), file)
        write_beside(dataset, RUNS_FOLDER, f"{night}.parquet", file.getvalue().to_pybytes())
        write_beside(dataset, RUNS_FOLDER, METRICS, metrics(row, counts).encode())
    except DatasetError as error:
        LOGGER.warning("the run of %s could not be recorded: %s", night, error)
        return True
    compared = ("state", "needs_look", *(["message"] if state is RunState.FAILED else []))
    return before is None or any(before[name] != row[name] for name in compared)


def _counts(dataset: str, night: str) -> dict[str, int]:
    """Return the counts of a published night that are metrics."""
    row = night_row(dataset, night) or {}
    return {name: row[name] for name in COUNTED if name in row}


def metrics(row: Mapping[str, Any], counts: Mapping[str, int]) -> str:
    """Return the metrics of a run as OpenMetrics text."""
    values: dict[str, float] = {
        "run_made": float(row["state"] == RunState.MADE),
        "run_end_timestamp_seconds": row["ended"] / 1e9,
        "run_duration_seconds": row["duration_s"],
        "run_cpu_seconds": row["cpu_s"],
        "run_memory_bytes": row["memory_mib"] * 2**20,
        "night_needs_look": len(row["needs_look"]),
        **{f"night_{name}": count for name, count in counts.items()},
    }
    lines = [
        line
        for name, value in values.items()
        for line in (
            f"# TYPE epipole_{name} gauge",
            f'epipole_{name}{{night="{row["night"]}"}} {value:.15g}',
        )
    ]
    return "\n".join([*lines, "# EOF"]) + "\n"


def record_unchanged(summary: Summary, used: Stopwatch, settings: Settings) -> Summary:
    """Return the summary of unchanged nights with what needed a look when they were made.

    A night whose last run did not publish it, or has no record, gets a record: it is made.
    """
    records = read_records(summary.dataset, summary.nights)
    for night in summary.nights:
        if night not in records or records[night]["state"] != RunState.MADE:
            write_record(summary.dataset, night, RunState.MADE, summary.sentence(), used, settings)
    found = {n: records[n]["needs_look"] for n in summary.nights if n in records}
    return replace(summary, looks=found)


def new_broken_logs(dataset: str, night: str) -> list[str]:
    """Return a sentence for each log that gave nothing, which no night of the month before had."""
    before: set[str] = set()
    if today := _broken(dataset, night):
        for date in set(nights_in(dataset)).intersection(nights_before(night, MONTH)):
            before |= _broken(dataset, date).keys()
    return [f"{log} {_BROKEN[reason]}" for log, reason in today.items() if log not in before]


def _broken(dataset: str, night: str) -> dict[str, str]:
    rows = read_table(dataset, "rejects", night, ["source", "reason"]).to_pylist()
    return {row["source"]: row["reason"] for row in rows if row["reason"] in _BROKEN}


def all_dates(dates: Sequence[str]) -> list[str]:
    """Return all dates from the first to the last of these."""
    if not dates:
        return []
    first, last = (datetime.date.fromisoformat(f(dates)) for f in (min, max))
    return [
        (first + datetime.timedelta(days=k)).isoformat() for k in range((last - first).days + 1)
    ]


def _versions() -> str:
    libraries = [f"{name} {metadata.version(name)}" for name in LIBRARIES]
    of_python = f"Python {platform.python_version()}"
    return ", ".join([f"epipole {metadata.version('epipole')}", of_python, *libraries])


def _run_id() -> str | None:
    import sys

    if "prefect.runtime" not in sys.modules:  # an unchanged night needs no Prefect
        return None
    from prefect.runtime import flow_run

    return str(flow_run.id) if flow_run.id else None

"""Unchanged nights: a run would make them as they are published, from the same logs."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pyarrow as pa

from epipole.flows.night.dataset.earlier_nights import EarlierNights
from epipole.flows.night.dataset.night_rows import recipe_in
from epipole.flows.night.log_choice import FoundLogs, name_of
from epipole.io.datasets.dataset import missing_tables, night_row, nights_in, read_table
from epipole.io.logs.mcap.bytes import open_log
from epipole.io.work.recipe import logs_key, recipe_of
from epipole.schemas.bridge import array
from epipole.schemas.errors import DatasetError
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS

HASHED_AT_ONCE = 2  # logs


def unchanged_nights(
    dataset: str, given: FoundLogs, night: str | None, settings: Settings, known: str | None
) -> list[str]:
    """Return the nights that a run would make; none unless all are published just as it would.

    Parameters
    ----------
    given
        The logs of the run.
    night
        The one that is asked for; None: all that the logs have frames of.
    known
        Digest of the catalogue of known objects.

    Notes
    -----
    Logs are the same where their bytes are: they are read once, to be hashed, and only if their
    names and sizes are those of the published night.
    """
    try:
        rows = _rows(dataset, night)
        made_so = {
            date: row
            for date, row in rows.items()
            if recipe_in(row) == recipe_of(row["logs_key"], settings, known)
        }
        same = [date for date in made_so if _same_names(given, _sources(dataset, date))]
        if not same:
            return []
        key = _key_of(given)
        same = [date for date in same if made_so[date]["logs_key"] == key]
        if not same or not _all_nights(dataset, same, night):
            return []
        earlier = EarlierNights(dataset, {})
        intact = all(
            made_so[date]["earlier_key"] == earlier.key(date, settings)
            and not missing_tables(dataset, date)
            for date in same
        )
    except (DatasetError, OSError):  # making the night again tells what is wrong with it
        return []
    return same if intact else []


def _rows(dataset: str, night: str | None) -> dict[str, dict[str, Any]]:
    """Return the row of `nights` of each published night, or of the one that is asked for."""
    dates = [date for date in nights_in(dataset) if night in (None, date)]
    rows = {date: night_row(dataset, date) for date in dates}
    return {date: row for date, row in rows.items() if row is not None}


def _sources(dataset: str, night: str) -> pa.Table:
    return read_table(dataset, "sources", night)


def _same_names(given: FoundLogs, sources: pa.Table) -> bool:
    """Return whether logs may be those of a night; a second copy of a log is no source."""
    return {name_of(path) for path in given.paths} >= set(sources["name"].to_pylist())


def _key_of(given: FoundLogs) -> str:
    """Return the `logs_key` of logs. Of those with the same bytes the first name counts."""
    with ThreadPoolExecutor(HASHED_AT_ONCE, "hash logs") as pool:
        digests = list(pool.map(_sha256, given.paths))
    by_content: dict[str, str] = {}
    for name, sha256 in sorted(zip(map(name_of, given.paths), digests, strict=True)):
        by_content.setdefault(sha256, name)
    logs = [(name, sha256) for sha256, name in by_content.items()]
    return logs_key(logs, given.rejects["source"].to_pylist())


def _sha256(path: str) -> str:
    with open_log(path) as log:
        return log.sha256()


def _all_nights(dataset: str, same: Sequence[str], night: str | None) -> bool:
    """Return whether no other night can have frames of the logs that made these."""
    if night is not None:
        return True
    sources = _sources(dataset, same[0])
    days = zip(
        (array(sources, "first_time") // DAY_NS).tolist(),
        (array(sources, "last_time") // DAY_NS).tolist(),
        strict=True,
    )
    dates = {str(np.datetime64(d, "D")) for first, last in days for d in range(first, last + 1)}
    return dates <= set(same)

"""The published nights of a dataset: what a run reads of them, and whether they are up to date.

Each night says in its table `nights` what it was made from. A run takes objects over from the
nights before, and skips a night that it would make unchanged. Another program may have written
these nights: they are read in pieces, only what is needed is kept, and a night that does not fit is
skipped.
"""

import logging
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from importlib import metadata
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple, TypeVar

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.flows.night.log_choice import FoundLogs, end_ns, name_of
from epipole.flows.night.summary import count
from epipole.io.datasets.dataset import (
    finish_publication,
    missing_tables,
    night_row,
    nights_in,
    read_table,
    table_pieces,
)
from epipole.io.datasets.night_tables import read_columns, write_table
from epipole.io.datasets.table_pieces import MAX_BYTES, within_bounds
from epipole.io.logs.logged_times import ReadBytes, open_mcap, read_digest
from epipole.io.work.recipe import Recipe, digest_of, logs_key, recipe_of
from epipole.schemas.bridge import (
    array,
    concat,
    from_polars,
    rows_with,
    table,
    table_name,
    to_polars,
)
from epipole.schemas.dates import MONTH, nights_before
from epipole.schemas.errors import DatasetError, LogError
from epipole.schemas.rejects import Reason
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS, SPAN_NS, day_of
from epipole.schemas.tables import NIGHTS, ORBITS, STATES
from epipole.schemas.work_tables import LAST_FRAMES, OBJECT_DETECTIONS, LogSource
from epipole.tasks.name.earlier_objects import EarlierObjects, EarlierViews

# The table `nights`: what a night was made from, with which settings, and what it has.


def write_night_row(
    folder: Path,
    recipe: Recipe,
    earlier_key: str,
    faults: Sequence[object],
    residuals: Sequence[object],
) -> None:
    """Write the table `nights` of a night whose other tables are written to `folder`.

    Parameters
    ----------
    earlier_key
        What the nights before were made from; see `EarlierNights.key`.
    faults, residuals
        Of sensors; each as text is a sentence.
    """
    row = {
        **{f"{name}_key": key for name, key in recipe._asdict().items()},
        "code_version": metadata.version("epipole"),
        "earlier_key": earlier_key,
        **count([folder]),
        "sensor_ids": sorted(set(read_columns(folder, "frames", ["sensor_id"])[0].to_pylist())),
        "faults": [str(fault) for fault in faults],
        "residuals": [str(residual) for residual in residuals],
    }
    write_table(folder, "nights", [table(NIGHTS, {name: [row[name]] for name in NIGHTS.names})])


def recipe_in(row: dict[str, Any]) -> Recipe:
    """Return the recipe in a row of `nights`."""
    return Recipe(*(row[f"{name}_key"] for name in Recipe._fields))


def key_of(row: dict[str, Any] | None) -> str:
    """Return a digest of what a night was made from; "unknown" where it has no row."""
    if row is None:
        return "unknown"
    return digest_of([*(key or "" for key in recipe_in(row)), row["earlier_key"]])


# What a run reads of the nights before.

LOGGER = logging.getLogger(__name__)

HOUR_NS = 3_600_000_000_000

T = TypeVar("T")


@dataclass(frozen=True)
class EarlierNights:
    """The nights of a dataset, and those that this run has staged: these count first."""

    dataset: str
    staged: Mapping[str, Path]
    _left_out: set[str] = field(default_factory=set)  # that cannot be read
    _rows: dict[str, dict[str, Any] | None] = field(default_factory=dict)  # of `nights`

    def last_views(self, night: str) -> EarlierViews:
        """Return the detections of the last half hour before a night, each once, and its frames.

        Objects that were followed over midnight keep their ids.
        """
        before = str(np.datetime64(night, "D") - 1)
        start_ns = day_of(night) * DAY_NS
        between_ns = (start_ns - SPAN_NS, start_ns)
        found = self._read(before, lambda where: _views(where, before, between_ns))
        return found or EarlierViews(OBJECT_DETECTIONS.empty_table(), LAST_FRAMES.empty_table())

    def last_objects(self, night: str, settings: Settings) -> EarlierObjects:
        """Return the last states and orbits of each object before a night.

        As far back as objects are recognised.
        """
        start_ns = day_of(night) * DAY_NS
        between_ns = (start_ns - round(settings.known_objects.earlier_h * HOUR_NS), start_ns)

        def rows(schema: pa.Schema) -> pa.Table:
            def of_night(date: str) -> pa.Table | None:
                return self._read(date, lambda where: _last(schema, where, date, between_ns))

            return concat(schema, filter(None, map(of_night, self._dates(night, settings))))

        return EarlierObjects(rows(STATES), rows(ORBITS))

    def _dates(self, night: str, settings: Settings) -> list[str]:
        """Return the nights before a night that it depends on, at least that of the day before."""
        back_ns = max(round(settings.known_objects.earlier_h * HOUR_NS), SPAN_NS)
        first = (day_of(night) * DAY_NS - back_ns) // DAY_NS
        nights = {str(np.datetime64(day, "D")) for day in range(first, day_of(night))}
        return sorted(nights.intersection([*nights_in(self.dataset), *self.staged]))

    def usual_sensors(self, night: str) -> list[str]:
        """Return the sensors that at least half of the nights in the month before a night have."""
        dates = {*nights_in(self.dataset), *self.staged}.intersection(nights_before(night, MONTH))
        before = [row for date in sorted(dates) if (row := self._row(date)) is not None]
        # A night of before they were recorded has sensors, but no names of them.
        named = [row["sensor_ids"] for row in before if row["sensor_ids"] or not row["sensors"]]
        nights = Counter(name for names in named for name in names)
        return sorted(name for name, count in nights.items() if 2 * count >= len(named))

    def key(self, night: str, settings: Settings) -> str:
        """Return a digest of what the nights were made from that the other methods read."""
        made_from = [f"{d} {key_of(self._row(d))}" for d in self._dates(night, settings)]
        usual = [] if settings.sensors.expected is not None else self.usual_sensors(night)
        return digest_of([*made_from, *usual])

    def _row(self, night: str) -> dict[str, Any] | None:
        if night not in self._rows:
            self._rows[night] = self._read(night, partial(night_row, night=night))
        return self._rows[night]

    def _read(self, night: str, read: Callable[[str], T | None]) -> T | None:
        """Return what is read of an earlier night; None where it cannot be read.

        A damaged night does not stop the nights after it, and has one line.
        """
        if night in self._left_out:
            return None
        try:
            return read(str(self.staged[night].parent) if night in self.staged else self.dataset)
        except DatasetError as error:
            LOGGER.warning("objects are not recognised from the night %s: %s", night, error)
            self._left_out.add(night)
            return None


def _views(where: str, night: str, between_ns: tuple[int, int]) -> EarlierViews:
    def used(rows: pa.Table) -> pa.Table:
        chosen = to_polars(rows).filter("used").drop_nulls("centroid")
        return from_polars(OBJECT_DETECTIONS, chosen.unique(maintain_order=True))

    pieces = table_pieces(where, "associations", night, OBJECT_DETECTIONS.names, between_ns)
    views = _kept(OBJECT_DETECTIONS, map(used, pieces), f"{where}/night={night}/associations")
    pieces = table_pieces(where, "frames", night, LAST_FRAMES.names, between_ns)
    frames = _kept(LAST_FRAMES, map(_last_frames, pieces), f"{where}/night={night}/frames")
    return EarlierViews(views, _last_frames(frames))


def _last_frames(rows: pa.Table) -> pa.Table:
    """Return the last row of each sensor: of FRAMES, LAST_FRAMES."""
    ordered = to_polars(rows).sort("time", "sensor_id")
    return from_polars(LAST_FRAMES, ordered.unique("sensor_id", keep="last", maintain_order=True))


def _last(schema: pa.Schema, where: str, night: str, between_ns: tuple[int, int]) -> pa.Table:
    """Return the last row of each object: of STATES or ORBITS."""
    name = table_name(schema)
    numbers = [column.name for column in STATES if column.type == pa.float64()]

    def last(rows: pa.Table) -> pa.Table:
        finite = to_polars(rows).filter(pl.all_horizontal(pl.col(numbers).is_finite()))
        ordered = finite.sort("epoch", maintain_order=True)
        return from_polars(schema, ordered.unique("object_id", keep="last", maintain_order=True))

    pieces = table_pieces(where, name, night, schema.names, between_ns)
    return _kept(schema, map(last, pieces), f"{where}/night={night}/{name}")


def _kept(schema: pa.Schema, pieces: Iterable[pa.Table], where: str) -> pa.Table:
    try:
        return concat(schema, within_bounds(pieces, MAX_BYTES))
    except ValueError as error:
        raise DatasetError(f"{where}: cannot be read ({error})") from error


# Which nights are out of date.

# What differs, by the field of a `Recipe`. Logs are not compared.
_DIFFERS = {
    "settings": "other settings",
    "star_catalogue": "another star catalogue",
    "code": "other code",
    "known": "another catalogue of known objects",
}


@dataclass(frozen=True)
class PublishedNight:
    """A night of a dataset: its row of `nights`, empty without one, and why it is stale."""

    date: str
    row: dict[str, Any]
    stale: list[str]

    def as_dict(self) -> dict[str, Any]:
        """Return the night as JSON takes it."""
        return {"night": self.date, "stale": self.stale, **self.row}


def published_nights(dataset: str, settings: Settings, known: str | None) -> list[PublishedNight]:
    """Return the nights of a dataset in order.

    Parameters
    ----------
    settings
        Those that a run would have today.
    known
        Digest of the catalogue of known objects that a run would have. None: whatever each night
        was made with.
    """
    earlier = EarlierNights(dataset, {})
    return [
        published_night(dataset, date, settings, known, earlier=earlier)
        for date in nights_in(dataset)
    ]


def published_night(
    dataset: str, date: str, settings: Settings, known: str | None,
    given: FoundLogs | None = None, earlier: EarlierNights | None = None,
) -> PublishedNight:  # fmt: skip
    """Return a night as `published_nights` does; with the logs of a run they are compared too.

    A night of which a log is not among these cannot be made: its logs are not compared.
    """
    try:
        missing = missing_tables(dataset, date)
        row = night_row(dataset, date)
        made = None if given is None or row is None else made_from(dataset, date, given)
    except DatasetError as error:
        return PublishedNight(date, {}, [str(error)])
    if row is None:
        return PublishedNight(date, {}, ["an older version"])
    made_with = recipe_in(row)
    today = recipe_of(row["logs_key"], settings, known or row["known_key"])
    stale = [
        text for name, text in _DIFFERS.items() if getattr(made_with, name) != getattr(today, name)
    ]
    if given and made and night_logs_key(given, date, made) != row["logs_key"]:
        stale.append("other logs")
    earlier = earlier or EarlierNights(dataset, {})
    if row["earlier_key"] != earlier.key(date, settings):
        stale.append("another night before")
    return PublishedNight(date, row, stale + [f"no table {name}" for name in missing])


# Unchanged nights: a run would make them as they are, from the same logs.

HASHED_AT_ONCE = 2  # logs


class MadeFrom(NamedTuple):
    """Which logs gave a night something.

    names : of those that did
    empty : names and sizes of those that gave nothing
    read : by their names, what was read of those of one name
    """

    names: set[str]
    empty: set[tuple[str, int]]
    read: Mapping[str, ReadBytes] = MappingProxyType({})


def night_logs_key(given: FoundLogs, night: str, made: MadeFrom) -> str:
    """Return the `logs_key` of a night: of its logs, as far as the night may depend on their bytes.

    `made` is what it was made from, and `given` are all logs of the run.
    """
    until_ns = end_ns(night)
    paths = _logs_of(given, night, made)
    with ThreadPoolExecutor(HASHED_AT_ONCE, "hash logs") as pool:
        read = [made.read.get(name_of(path)) for path in paths]
        digests = list(pool.map(read_digest, paths, [until_ns] * len(paths), read))
    return logs_key(zip(map(name_of, paths), digests, strict=True))


def gave_something(sources: Sequence[LogSource], rejects: pa.Table, night: str) -> MadeFrom:
    """Return which logs gave something to a night, and which nothing at all.

    `sources` are those that gave something to any night, `rejects` what reading left out.
    """
    day = day_of(night)
    of_night = {
        log.name
        for log in sources
        if (log.first_time_ns or 0) // DAY_NS <= day <= (log.last_time_ns or 0) // DAY_NS
    }
    names = Counter(log.name for log in sources)
    read = {log.name: ReadBytes(log.sha256, log.size) for log in sources if names[log.name] == 1}
    return MadeFrom(of_night, _empty(rejects), read)


def _empty(rejects: pa.Table) -> set[tuple[str, int]]:
    """Return the names and sizes of logs that gave nothing."""
    rows = rows_with(rejects, "reason", Reason.NOTHING_READ).to_pylist()
    return {(row["source"], row["offset"]) for row in rows}


def _logs_of(given: FoundLogs, night: str, made: MadeFrom) -> list[str]:
    may = set(given.of(night))
    return [
        path
        for path in given.paths
        if (path in may or name_of(path) in made.names) and not _is_among(path, made.empty)
    ]


def _is_among(path: str, logs: Collection[tuple[str, int]]) -> bool:
    """Return whether a log is one of these, by name and size."""
    name = name_of(path)
    if not any(name == other for other, _ in logs):
        return False
    with open_mcap(path) as log:
        return (name, len(log)) in logs


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
    names are those of the published night. Logs that give nothing do not count. Nights that an
    earlier run has published and not finished are finished before.

    Raises
    ------
    DatasetError
        Where these cannot be finished.
    """
    finish_publication(dataset)
    try:
        rows = _rows(dataset, night)
        made_so = {
            date: row
            for date, row in rows.items()
            if recipe_in(row) == recipe_of(row["logs_key"], settings, known)
        }
        logs = {date: made for date in made_so if (made := made_from(dataset, date, given))}
        same = [
            date
            for date, made in logs.items()
            if night_logs_key(given, date, made) == made_so[date]["logs_key"]
        ]
        if not same or not (night or _all_nights(dataset, given, {d: logs[d] for d in same})):
            return []
        earlier = EarlierNights(dataset, {})
        intact = all(
            made_so[date]["earlier_key"] == earlier.key(date, settings)
            and not missing_tables(dataset, date)
            for date in same
        )
    except (DatasetError, LogError, OSError):  # making the night again shows what is wrong with it
        return []
    return same if intact else []


def _rows(dataset: str, night: str | None) -> dict[str, dict[str, Any]]:
    """Return the row of `nights` of each published night, or of the one that is asked for."""
    dates = [date for date in nights_in(dataset) if night in (None, date)]
    rows = {date: night_row(dataset, date) for date in dates}
    return {date: row for date, row in rows.items() if row is not None}


def made_from(dataset: str, night: str, given: FoundLogs) -> MadeFrom | None:
    """Return which logs a night was made from; None where they are not among those given.

    A second copy of a log is not in the sources.
    """
    names = set(read_table(dataset, "sources", night, ["name"])["name"].to_pylist())
    if not names <= {name_of(path) for path in given.paths}:
        return None
    rejects = read_table(dataset, "rejects", night, ["source", "reason", "offset"])
    return MadeFrom(names, _empty(rejects))


def _all_nights(dataset: str, given: FoundLogs, same: Mapping[str, MadeFrom]) -> bool:
    """Return whether no other night can have frames of the logs of these."""
    known: set[str] = set()
    for date, made in same.items():
        known.update(path for path in given.paths if _is_among(path, made.empty))
        known.update(_logs_of(given, date, made))
    dates: set[str] = set()
    for date in same:
        sources = read_table(dataset, "sources", date)
        days = zip(
            (array(sources, "first_time") // DAY_NS).tolist(),
            (array(sources, "last_time") // DAY_NS).tolist(),
            strict=True,
        )
        dates |= {
            str(np.datetime64(d, "D")) for first, last in days for d in range(first, last + 1)
        }
    return known >= set(given.paths) and dates <= set(same)

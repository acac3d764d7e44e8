"""Earlier nights: what this run, or an earlier one, has published of the nights before a night.

Another program may have written them. So they are read in pieces, of which only what later nights
need is kept, and a night that does not fit is left out.
"""

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TypeVar

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.flows.night.dataset.night_rows import key_of
from epipole.io.datasets.dataset import night_row, nights_in, table_pieces
from epipole.io.datasets.table_pieces import MOST_BYTES, within_bounds
from epipole.io.work.recipe import digest_of
from epipole.schemas.bridge import concat, from_polars, to_polars
from epipole.schemas.errors import DatasetError
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS, SPAN_NS, day_of
from epipole.schemas.tables import STATES
from epipole.tasks.name.followed_objects import VIEWS

LOGGER = logging.getLogger(__name__)

HOUR_NS = 3_600_000_000_000

T = TypeVar("T")


@dataclass(frozen=True)
class EarlierNights:
    """The nights of a dataset, and those that this run has staged: these count first."""

    dataset: str
    staged: Mapping[str, Path]
    _left_out: set[str] = field(default_factory=set)  # that cannot be read

    def last_views(self, night: str) -> pa.Table:
        """Return the `VIEWS` of the last half hour before a night, each detection once.

        Objects that were followed over midnight keep their ids.
        """
        before = str(np.datetime64(night, "D") - 1)
        start_ns = day_of(night) * DAY_NS
        between_ns = (start_ns - SPAN_NS, start_ns)
        found = self._read(before, lambda where: _views(where, before, between_ns))
        return found or VIEWS.empty_table()

    def last_states(self, night: str, settings: Settings) -> pa.Table:
        """Return the last STATES of each object before a night.

        As far back as objects are recognised.
        """
        start_ns = day_of(night) * DAY_NS
        between_ns = (start_ns - round(settings.known_objects.earlier_h * HOUR_NS), start_ns)

        def states(date: str) -> pa.Table | None:
            return self._read(date, lambda where: _states(where, date, between_ns))

        return concat(STATES, filter(None, map(states, self._dates(night, settings))))

    def _dates(self, night: str, settings: Settings) -> list[str]:
        """Return the nights before a night that it depends on, at least that of the day before."""
        back_ns = max(round(settings.known_objects.earlier_h * HOUR_NS), SPAN_NS)
        first = (day_of(night) * DAY_NS - back_ns) // DAY_NS
        nights = {str(np.datetime64(day, "D")) for day in range(first, day_of(night))}
        return sorted(nights.intersection([*nights_in(self.dataset), *self.staged]))

    def key(self, night: str, settings: Settings) -> str:
        """Return a digest of what the nights were made from that the other methods read."""
        made_from = {
            date: self._read(date, partial(night_row, night=date))
            for date in self._dates(night, settings)
        }
        return digest_of(f"{date} {key_of(row)}" for date, row in made_from.items())

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


def _views(where: str, night: str, between_ns: tuple[int, int]) -> pa.Table:
    def used(rows: pa.Table) -> pa.Table:
        chosen = to_polars(rows).filter("used").drop_nulls("centroid")
        return from_polars(VIEWS, chosen.unique(maintain_order=True))

    pieces = table_pieces(where, "associations", night, VIEWS.names, between_ns)
    return _kept(VIEWS, map(used, pieces), f"{where}/night={night}/associations")


def _states(where: str, night: str, between_ns: tuple[int, int]) -> pa.Table:
    numbers = [column.name for column in STATES if column.type == pa.float64()]

    def last(rows: pa.Table) -> pa.Table:
        finite = to_polars(rows).filter(pl.all_horizontal(pl.col(numbers).is_finite()))
        ordered = finite.sort("epoch", maintain_order=True)
        return from_polars(STATES, ordered.unique("object_id", keep="last", maintain_order=True))

    pieces = table_pieces(where, "states", night, STATES.names, between_ns)
    return _kept(STATES, map(last, pieces), f"{where}/night={night}/states")


def _kept(schema: pa.Schema, pieces: Iterable[pa.Table], where: str) -> pa.Table:
    try:
        return concat(schema, within_bounds(pieces, MOST_BYTES))
    except ValueError as error:
        raise DatasetError(f"{where}: cannot be read ({error})") from error

"""Earlier nights: what this run, or an earlier one, has published of the nights before a night."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from epipole.flows.night.dataset.night_rows import key_of
from epipole.io.datasets.dataset import nights_in, read_table
from epipole.io.work.recipe import digest_of
from epipole.schemas.bridge import concat
from epipole.schemas.errors import DatasetError
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS, SPAN_NS, day_of
from epipole.schemas.tables import NIGHTS, STATES, TABLES
from epipole.tasks.name.followed_objects import VIEWS

LOGGER = logging.getLogger(__name__)

HOUR_NS = 3_600_000_000_000


class EarlierNights(NamedTuple):
    """The nights of a dataset, and those that this run has staged: these count first."""

    dataset: str
    staged: Mapping[str, Path]

    def last_views(self, night: str) -> pa.Table:
        """Return the `VIEWS` of the last half hour before a night.

        Objects that were followed over midnight keep their ids.
        """
        before = str(np.datetime64(night, "D") - 1)
        since_ns = day_of(night) * DAY_NS - SPAN_NS
        return self._read("associations", before, VIEWS.names, since_ns)

    def last_states(self, night: str, settings: Settings) -> pa.Table:
        """Return the STATES before a night, as far back as objects are recognised."""
        start_ns = day_of(night) * DAY_NS
        since_ns = start_ns - round(settings.known_objects.earlier_h * HOUR_NS)
        return concat(
            STATES,
            [
                self._read("states", date, STATES.names, since_ns)
                for date in self._dates(night, settings)
            ],
        )

    def _dates(self, night: str, settings: Settings) -> list[str]:
        """Return the nights before a night that it depends on, at least that of the day before."""
        back_ns = max(round(settings.known_objects.earlier_h * HOUR_NS), SPAN_NS)
        first = (day_of(night) * DAY_NS - back_ns) // DAY_NS
        nights = {str(np.datetime64(day, "D")) for day in range(first, day_of(night))}
        return sorted(nights.intersection([*nights_in(self.dataset), *self.staged]))

    def key(self, night: str, settings: Settings) -> str:
        """Return a digest of what the nights were made from that the other methods read."""
        made_from = {
            date: self._read("nights", date, NIGHTS.names).to_pylist()
            for date in self._dates(night, settings)
        }
        return digest_of(
            f"{date} {key_of(rows[0] if rows else None)}" for date, rows in made_from.items()
        )

    def _read(
        self, table: str, night: str, columns: Sequence[str], since_ns: int | None = None
    ) -> pa.Table:
        """Return the end of a table of an earlier night; no rows where it cannot be read.

        A damaged night does not stop the nights after it.
        """
        where = str(self.staged[night].parent) if night in self.staged else self.dataset
        try:
            return read_table(where, table, night, columns, since_ns)
        except DatasetError as error:
            LOGGER.warning("objects are not recognised from the night %s: %s", night, error)
            return pa.schema([TABLES[table].field(name) for name in columns]).empty_table()

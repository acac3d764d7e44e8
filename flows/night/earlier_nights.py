"""Earlier nights: what this run, or an earlier one, has published of the nights before a night."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from epipole.flows.night.work import day_of
from epipole.io.datasets.dataset import nights_in, read_table
from epipole.schemas.bridge import concat
from epipole.schemas.errors import DatasetError
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS, SPAN_NS
from epipole.schemas.tables import STATES, TABLES
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
        days = range(since_ns // DAY_NS, day_of(night))
        nights = {str(np.datetime64(day, "D")) for day in days}
        held = sorted(nights.intersection([*nights_in(self.dataset), *self.staged]))
        return concat(STATES, [self._read("states", date, STATES.names, since_ns) for date in held])

    def _read(self, table: str, night: str, columns: Sequence[str], since_ns: int) -> pa.Table:
        """Return the end of a table of an earlier night; no rows where it cannot be read.

        A damaged night does not stop the nights after it.
        """
        where = str(self.staged[night].parent) if night in self.staged else self.dataset
        try:
            return read_table(where, table, night, columns, since_ns)
        except DatasetError as error:
            LOGGER.warning("objects are not recognised from the night %s: %s", night, error)
            return pa.schema([TABLES[table].field(name) for name in columns]).empty_table()

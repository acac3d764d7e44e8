"""Earlier nights: what this run, or an earlier one, has published of the nights before a night."""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from epipole.flows.night.work import day_of
from epipole.io.datasets.dataset import nights_in, read_table
from epipole.schemas.bridge import concat
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS, SPAN_NS
from epipole.schemas.tables import STATES
from epipole.tasks.name.followed_objects import VIEWS

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
        return read_table(self._where(before), "associations", before, VIEWS.names, since_ns)

    def last_states(self, night: str, settings: Settings) -> pa.Table:
        """Return the STATES before a night, as far back as objects are recognised."""
        start_ns = day_of(night) * DAY_NS
        since_ns = start_ns - round(settings.known_objects.earlier_h * HOUR_NS)
        days = range(since_ns // DAY_NS, day_of(night))
        nights = {str(np.datetime64(day, "D")) for day in days}
        held = sorted(nights.intersection([*nights_in(self.dataset), *self.staged]))
        tables = [read_table(self._where(date), "states", date, since_ns=since_ns) for date in held]
        return concat(STATES, tables)

    def _where(self, night: str) -> str:
        """Return the folder that has a night."""
        return str(self.staged[night].parent) if night in self.staged else self.dataset

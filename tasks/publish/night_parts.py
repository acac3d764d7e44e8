"""What the tables of a night are made from."""

from collections.abc import Mapping
from typing import NamedTuple

import pyarrow as pa

from epipole.io.work.places import SensorParts, SolvedParts
from epipole.schemas.spans import Span


class NightParts(NamedTuple):
    """The parts and tables from which the tables of a night are made.

    `spans` are the night's, in order, and `all_spans` the run's. `names` has, for the folder of
    each span, the names of its objects in the night. `whole` has tables of the whole run:
    `calibrations`, `sources`, and the `rejects` that belong to no span.
    """

    night: str
    spans: list[Span]
    all_spans: list[Span]
    sensors: list[SensorParts]
    solved: SolvedParts
    names: Mapping[str, Mapping[str, str]]
    whole: Mapping[str, pa.Table]

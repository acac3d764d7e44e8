"""What the tables of a night are made from."""

from collections.abc import Mapping
from typing import NamedTuple

import pyarrow as pa

from epipole.io.work.places import SensorParts, SolvedParts
from epipole.schemas.spans import Span


class NightParts(NamedTuple):
    """The parts and tables from which the tables of a night are made.

    `spans` are the night's, in order; `all_spans` also has one before and after it. `names` has,
    for the folder of each span, the names in the night of its objects. `whole` has tables that
    belong to no span: `calibrations`, `sources`, and some of the `rejects`.
    """

    night: str
    spans: list[Span]
    all_spans: list[Span]
    sensors: list[SensorParts]
    solved: SolvedParts
    names: Mapping[str, Mapping[str, str]]
    whole: Mapping[str, pa.Table]

"""The tables of each kind of part, by name; `write_part` refuses any other.

Tables may add metadata to a declared schema, such as the catalogue of `stars`.
"""

from collections.abc import Mapping
from typing import Final

import pyarrow as pa

from epipole.schemas.logs.log_tables import LOG_STATES
from epipole.schemas.tables import (
    ASSOCIATIONS,
    DETECTIONS,
    PAIRS,
    POSITIONS,
    REJECTS,
    STARS,
    STATES,
)
from epipole.schemas.work_tables import (
    CAMERAS,
    CLAIMED_VIEWS,
    CLOCK_LINES,
    EXPOSURES,
    FRAME_INDEX,
    HOT_SUSPECTS,
    MOVING_OBJECTS,
    OBJECT_MEMBERS,
    SENSOR_EPOCHS,
    SENSOR_STATES,
    SHARED_ERRORS,
    SIGHTINGS,
    SOLUTIONS,
    TRACKLET_NAMES,
    TRACKLET_OUTCOMES,
    TRACKLET_RUNS,
    VIEWED_TRACKLETS,
    VIEWS,
)

PartTables = Mapping[str, pa.Schema]

LOG_PIECE: Final[PartTables] = {
    "exposures": EXPOSURES,
    "states": LOG_STATES,
    "cameras": CAMERAS,
    "rejects": REJECTS,
}
READ_SENSOR: Final[PartTables] = {"index": FRAME_INDEX, "states": SENSOR_STATES}
IDENTIFIED: Final[PartTables] = {
    "solutions": SOLUTIONS,
    "stars": STARS,
    "detections": DETECTIONS,
    "rejects": REJECTS,
}
TRACKED: Final[PartTables] = {
    "detections": DETECTIONS,
    "tracklets": TRACKLET_RUNS,
    "suspects": HOT_SUSPECTS,
}
SPAN_NAMES: Final[PartTables] = {"names": TRACKLET_NAMES}
NIGHT_TRACKLETS: Final[PartTables] = {"tracklets": TRACKLET_RUNS, "suspects": HOT_SUSPECTS}
VIEWED: Final[PartTables] = {
    "epochs": SENSOR_EPOCHS,
    "views": VIEWS,
    "sightings": SIGHTINGS,
    "tracklets": VIEWED_TRACKLETS,
}
ASSOCIATED: Final[PartTables] = {
    "members": OBJECT_MEMBERS,
    "rejects": REJECTS,
    "outcomes": TRACKLET_OUTCOMES,
}
NUMBERED: Final[PartTables] = {"members": OBJECT_MEMBERS}
JUDGED: Final[PartTables] = {"errors": SHARED_ERRORS}
SOLVED: Final[PartTables] = {
    "associations": ASSOCIATIONS,
    "positions": POSITIONS,
    "pairs": PAIRS,
    "states": STATES,
    "rejects": REJECTS,
    "outcomes": TRACKLET_OUTCOMES,
    "lines": CLOCK_LINES,
    "claims": CLAIMED_VIEWS,
    "objects": MOVING_OBJECTS,
}


def check_tables(part: str, declared: PartTables, tables: Mapping[str, pa.Table]) -> None:
    """Check that the tables of a part are those that are declared for it.

    Raises
    ------
    ValueError
        Names the part, the table, and the columns that are expected.
    """
    if set(tables) != set(declared):
        raise ValueError(f"{part}: tables {sorted(tables)}, expected {sorted(declared)}")
    for name, rows in tables.items():
        if not rows.schema.equals(declared[name]):
            raise ValueError(
                f"{part}: table {name}: columns {_columns(rows.schema)}, "
                f"expected {_columns(declared[name])}"
            )


def _columns(schema: pa.Schema) -> str:
    return ", ".join(str(field.remove_metadata()) for field in schema)

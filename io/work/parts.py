"""Parts: the tables that one task leaves in the work folder for others, as Arrow files.

A part appears by one rename, complete or not at all. So any task that finds a part can use it: a
later task, another worker on the same storage, or the next run after this one was killed.
"""

import contextlib
import os
import shutil
import uuid
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import pyarrow as pa
import pyarrow.ipc as ipc

from epipole.io.work.kept_parts import KEY, take_part
from epipole.schemas.bridge import concat
from epipole.schemas.errors import DatasetError
from epipole.schemas.spans import Span, spans_between
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
    ATTRIBUTABLES,
    CAMERAS,
    CLOCK_LINES,
    EXPOSURES,
    FITTED_OBSERVATIONS,
    FRAME_INDEX,
    HOT_SUSPECTS,
    LOG_STATES,
    MOVING_OBJECTS,
    OBJECT_MEMBERS,
    OBJECT_VIEWS,
    SENSOR_EPOCHS,
    SENSOR_STATES,
    SHARED_ERRORS,
    SHARED_OBSERVATIONS,
    SHARED_POSITIONS,
    SIGHTINGS,
    SOLUTIONS,
    TRACKLET_NAMES,
    TRACKLET_OUTCOMES,
    TRACKLET_RUNS,
    VIEWED_TRACKLETS,
    VIEWS,
)

# The tables of each kind of part, by name; `write_part` refuses any other. A table may have more
# metadata than its schema, such as the catalogue of `stars`.

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
    "attributables": ATTRIBUTABLES,
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
    "object_views": OBJECT_VIEWS,
    "objects": MOVING_OBJECTS,
}
SHARED_SEEN: Final[PartTables] = {"observations": SHARED_OBSERVATIONS}
SHARED_SOLVED: Final[PartTables] = {"positions": SHARED_POSITIONS}
FITTED: Final[PartTables] = {"observations": FITTED_OBSERVATIONS}


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


CLOCK_NS = 10_000_000_000  # the largest correction of a clock [ns]


def write_part(
    part: Path,
    declared: PartTables,
    tables: Mapping[str, pa.Table],
    within: Path | None = None,
    key: str | None = None,
) -> None:
    """Write the tables of a part, all of them or none. A part that exists stays unchanged.

    Parameters
    ----------
    declared
        The tables that the part must have: one of `epipole.io.work.parts`.
    within
        A parent folder that must exist. It is not created: a task that outlives its run would
        create the run's folder again.
    key
        That of `part_key`, by which a later run may find it; None: it is made in every run.

    Raises
    ------
    DatasetError
        Where the disk cannot be written, or `within` is missing.
    ValueError
        Where the tables are not the declared ones.
    """
    check_tables(f"{part.parent.name}/{part.name}", declared, tables)
    making = part.with_name(f".{part.name}-{uuid.uuid4().hex}")
    try:
        if within is not None and not within.is_dir():
            raise OSError(None, "its run has ended", str(within))
        making.mkdir(parents=True)
        for name, rows in tables.items():
            with (
                pa.OSFile(str(making / f"{name}.arrow"), "wb") as file,
                ipc.new_file(file, rows.schema) as writer,
            ):
                writer.write_table(rows)
        if key is not None:
            (making / KEY).write_text(key)
        with contextlib.suppress(OSError):  # another worker was first, with the same rows
            making.rename(part)
        if not part.is_dir():
            raise OSError(None, "cannot be renamed to its name", str(part))
    except OSError as error:
        raise DatasetError(
            f"{part}: cannot be written ({error.strerror or error}); nothing was changed"
        ) from error
    finally:
        shutil.rmtree(making, ignore_errors=True)


def is_written(part: Path) -> bool:
    """Return whether a part exists. A part that exists is complete."""
    return part.is_dir()


def read_part(part: Path, name: str, columns: Sequence[str] | None = None) -> pa.Table:
    """Return a table of a part, mapped into memory rather than read.

    Raises
    ------
    DatasetError
        Where it is missing or damaged.
    """
    path = part / f"{name}.arrow"
    try:
        # A buffer: Arrow hands the opening of a file to another thread, which doubles its time.
        with pa.memory_map(os.fspath(path)) as mapped, ipc.open_file(mapped.read_buffer()) as file:
            rows = file.read_all()
    except (OSError, pa.ArrowInvalid) as error:
        raise DatasetError(
            f"{path}: cannot be read ({error}); remove {part.parent.parent} and run again"
        ) from error
    return rows if columns is None else rows.select(list(columns))


class Parts(NamedTuple):
    """The parts of one stage, one per span: of one sensor, or of all sensors together.

    `kept` is the folder of the parts of earlier runs, by key; None: there are none.
    """

    folder: Path
    kept: Path | None = None

    def of(self, span: Span) -> Path:
        """Return the part of a span."""
        return self.folder / span.folder

    def of_night(self) -> Path:
        """Return the part of the whole night, of all spans together."""
        return self.folder / "night"

    def read(self, span: Span, name: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Return a table of a span's part; see `read_part`."""
        return read_part(self.of(span), name, columns)

    def holds(self, span: Span) -> bool:
        """Return whether the span's part exists."""
        return is_written(self.of(span))

    def take(self, span: Span, key: str | None) -> bool:
        """Take the span's part from those kept; return whether it was there. See `take_part`."""
        return take_part(self.of(span), self.kept, key)

    def written(self, spans: Iterable[Span]) -> list[Path]:
        """Return the parts of those spans that have one."""
        return [self.of(span) for span in spans if self.holds(span)]

    def rows_within(self, span: Span, schema: pa.Schema, name: str, time: str = "time") -> pa.Table:
        """Return a table's rows whose time lies in a span, from all parts that may have some.

        A frame whose clock was corrected may lie in the part of a neighbouring span.
        """
        return concat(schema, [span.of(self.read(near, name), time) for near in self.near(span)])

    def near(self, span: Span) -> list[Span]:
        """Return the spans with a part that may have rows of this one."""
        return [near for near in spans_between(*span.widened(CLOCK_NS)) if self.holds(near)]

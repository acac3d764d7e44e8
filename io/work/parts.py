"""Parts: the tables that one task leaves in the work folder for others, as Arrow files.

A part appears by one rename, complete or not at all. So any task that finds a part can use it: a
later task, another worker on the same storage, or the next run after this one was killed.
"""

import contextlib
import os
import shutil
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import pyarrow as pa
import pyarrow.ipc as ipc

from epipole.io.work.part_tables import PartTables, check_tables
from epipole.schemas.bridge import concat
from epipole.schemas.errors import DatasetError
from epipole.schemas.spans import Span, spans_between

CLOCK_NS = 10_000_000_000  # the largest correction of a clock


def write_part(
    part: Path,
    declared: PartTables,
    tables: Mapping[str, pa.Table],
    within: Path | None = None,
) -> None:
    """Write the tables of a part, all of them or none. A part that exists stays unchanged.

    Parameters
    ----------
    declared
        The tables that the part must have: one of `epipole.io.work.part_tables`.
    within
        A folder of the part that must exist. It is not made: a task that outlives its run would
        bring the run's folder back.

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
        with contextlib.suppress(OSError):  # another worker was first, with the same rows
            making.rename(part)
        if not part.is_dir():
            raise OSError(None, "cannot be put in place", str(part))
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
        with ipc.open_file(pa.memory_map(os.fspath(path))) as file:
            rows = file.read_all()
    except (OSError, pa.ArrowInvalid) as error:
        raise DatasetError(
            f"{path}: cannot be read ({error}); remove {part.parent.parent} and run again"
        ) from error
    return rows if columns is None else rows.select(list(columns))


class Parts(NamedTuple):
    """The parts of one stage, one per span: of one sensor, or of all sensors together."""

    folder: Path

    def of(self, span: Span) -> Path:
        """Return the part of a span."""
        return self.folder / span.folder

    def of_night(self) -> Path:
        """Return the part that all spans together give."""
        return self.folder / "night"

    def read(self, span: Span, name: str, columns: Sequence[str] | None = None) -> pa.Table:
        """Return a table of a span's part; see `read_part`."""
        return read_part(self.of(span), name, columns)

    def holds(self, span: Span) -> bool:
        """Return whether the span's part exists."""
        return is_written(self.of(span))

    def rows_within(self, span: Span, schema: pa.Schema, name: str, time: str = "time") -> pa.Table:
        """Return a table's rows whose time lies in a span, from all parts that may have some.

        A frame whose clock was corrected may lie in the part of a neighbouring span.
        """
        others = [other for other in spans_between(*span.widened(CLOCK_NS)) if self.holds(other)]
        return concat(schema, [span.of(self.read(other, name), time) for other in others])

"""Tables on their way from stage to stage: Arrow files in a run's work folder.

What a task writes appears by one rename, whole or not at all, so whoever finds a part may
use it: a later task, another worker on the same storage, or the next run after this one was
killed.
"""

import contextlib
import os
import shutil
import uuid
from collections.abc import Mapping, Sequence
from pathlib import Path

import pyarrow as pa
import pyarrow.ipc as ipc

from epipole.schemas.errors import DatasetError


def write_part(part: Path, tables: Mapping[str, pa.Table]) -> None:
    """Write the tables of a part, all of them or none; a part that is there stays.

    Raises
    ------
    DatasetError
        Where the disk refuses.
    """
    making = part.with_name(f".{part.name}-{uuid.uuid4().hex}")
    try:
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
    """Return whether a part is there; then it is whole."""
    return part.is_dir()


def read_part(part: Path, name: str, columns: Sequence[str] | None = None) -> pa.Table:
    """Return a table of a part, mapped into memory rather than read: use it and let it go.

    Raises
    ------
    DatasetError
        Where it is not there or damaged.
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

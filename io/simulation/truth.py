"""The truth of a simulated log: a folder beside the log."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from epipole.schemas.bridge import conform
from epipole.schemas.errors import DatasetError
from epipole.schemas.work_tables import TRUE_FRAMES, TRUE_POINTS

SUFFIX = ".truth"
_FILES = {"frames": TRUE_FRAMES, "points": TRUE_POINTS}


@dataclass(frozen=True)
class Truth:
    """The truth of a simulated log: its frames, its centroids, and the scene."""

    frames: pa.Table
    points: pa.Table
    scenario: dict[str, Any]


class TruthWriter:
    """Writes a truth folder, block by block; a context manager."""

    def __init__(self, folder: str | os.PathLike[str], scenario: dict[str, Any]) -> None:
        self._folder = Path(folder)
        self._folder.mkdir(parents=True, exist_ok=True)
        text = json.dumps(scenario, indent=1, allow_nan=False) + "\n"
        (self._folder / "scenario.json").write_text(text, encoding="utf-8")
        self._writers = {
            name: pq.ParquetWriter(self._folder / f"{name}.parquet", schema, compression="zstd")
            for name, schema in _FILES.items()
        }

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for writer in self._writers.values():
            writer.close()

    def write(self, frames: pa.Table, points: pa.Table) -> None:
        """Write rows of TRUE_FRAMES and TRUE_POINTS."""
        for name, rows in (("frames", frames), ("points", points)):
            if rows.num_rows:
                self._writers[name].write_table(conform(_FILES[name], rows))


def read_truth(path: str | os.PathLike[str]) -> Truth:
    """Return the truth in a folder. The log beside the folder may be named instead.

    Raises
    ------
    DatasetError
        Where the folder or a file of it is missing or cannot be read.
    """
    folder = Path(path)
    if not folder.is_dir() and Path(os.fspath(path) + SUFFIX).is_dir():
        folder = Path(os.fspath(path) + SUFFIX)
    if not folder.is_dir():
        raise DatasetError(f"{path}: no truth folder; `epipole simulate` writes it as LOG{SUFFIX}")
    tables = {}
    for name, schema in _FILES.items():
        tables[name] = _read(folder / f"{name}.parquet", schema)
    where = folder / "scenario.json"
    try:
        scenario = json.loads(where.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DatasetError(f"{where}: cannot be read: {error}") from error
    missing = [key for key in ("t0_ns", "sensors", "targets") if key not in scenario]
    if missing:
        raise DatasetError(f"{where}: {', '.join(missing)} missing")
    return Truth(tables["frames"], tables["points"], scenario)


def _read(path: Path, schema: pa.Schema) -> pa.Table:
    try:
        rows = pq.read_table(path, partitioning=None)
        return conform(schema, rows)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise DatasetError(f"{path}: cannot be read as truth: {error}") from error


def elements_of(truth: Truth) -> np.ndarray:
    """Return the (n, 6) orbital elements of the true objects at `t0_ns` [km and rad]."""
    elements = [target["elements"] for target in truth.scenario["targets"]]
    return np.array(elements, float).reshape(-1, 6)

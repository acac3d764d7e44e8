"""The truth of a simulated log: a folder beside the log."""

import json
import os
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from epipole.schemas.bridge import conform, to_polars
from epipole.schemas.errors import DatasetError
from epipole.schemas.work_tables import TRUE_FRAMES, TRUE_ORBITS, TRUE_POINTS

SUFFIX = ".truth"
OBJECT = 1  # value of `kind` in TRUE_POINTS
_ORBITS = "orbits.parquet"
_FILES = {"frames": TRUE_FRAMES, "points": TRUE_POINTS}


@dataclass(frozen=True)
class Truth:
    """The truth of a simulated log: its frames, its centroids, the scene, and sampled orbits.

    Without `orbits`, objects move by the `elements` of the targets of `scenario`.
    """

    frames: pa.Table  # TRUE_FRAMES
    points: pa.Table  # TRUE_POINTS
    scenario: dict[str, Any]
    orbits: pa.Table | None = None  # TRUE_ORBITS


class TruthWriter:
    """Writes a truth folder, block by block; a context manager."""

    def __init__(self, folder: str | os.PathLike[str], scenario: dict[str, Any]) -> None:
        self._folder = Path(folder).absolute()  # Arrow takes http:/x for a URL
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / _ORBITS).unlink(missing_ok=True)  # of an earlier log of this name
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

    def write_orbits(self, orbits: pa.Table) -> None:
        """Write rows of TRUE_ORBITS: all objects, where some do not move by two-body orbits."""
        rows = conform(TRUE_ORBITS, orbits)
        pq.write_table(rows, self._folder / _ORBITS, compression="zstd")


def read_truth(path: str | os.PathLike[str]) -> Truth:
    """Return the truth in a folder. The log, or folder of logs, beside it may be named instead.

    `orbits.parquet` is optional: objects that do not move by two-body orbits have it.

    Raises
    ------
    DatasetError
        Where the folder or a file of it is missing or cannot be read, or an object of the points
        has no orbit.
    """
    folder = Path(path)
    beside = Path(str(folder) + SUFFIX)
    if beside.is_dir() and not (folder / "scenario.json").is_file():
        folder = beside
    if not folder.is_dir():
        raise DatasetError(f"{path}: no truth folder; `epipole simulate` writes it as LOG{SUFFIX}")
    needed = [*(f"{name}.parquet" for name in _FILES), "scenario.json"]
    if missing := [name for name in needed if not (folder / name).is_file()]:
        raise DatasetError(
            f"{folder}: {', '.join(missing)} missing; give the folder LOG{SUFFIX} that "
            "`epipole simulate` writes beside a log"
        )
    tables = {name: _read(folder / f"{name}.parquet", schema) for name, schema in _FILES.items()}
    where = folder / _ORBITS
    orbits = _read(where, TRUE_ORBITS) if where.exists() else None
    truth = Truth(tables["frames"], tables["points"], _read_scenario(folder), orbits)
    _require_orbits(folder, truth)
    return truth


def _read_scenario(folder: Path) -> dict[str, Any]:
    where = folder / "scenario.json"
    try:
        scenario = json.loads(where.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DatasetError(f"{where}: cannot be read: {error}") from error
    missing = [key for key in ("t0_ns", "sensors", "targets") if key not in scenario]
    if missing:
        raise DatasetError(f"{where}: {', '.join(missing)} missing")
    return scenario


def _require_orbits(folder: Path, truth: Truth) -> None:
    """Raise where an object of the points has neither a sampled orbit nor elements."""
    if truth.orbits is None:
        targets = truth.scenario["targets"]
        known = [i for i, target in enumerate(targets) if "elements" in target]
        where = folder / "scenario.json"
    else:
        rows = to_polars(truth.orbits).group_by("object")
        times = rows.agg(n=pl.len(), n_times=pl.col("t_ns").n_unique())
        is_path = (pl.col("n") >= 2) & (pl.col("n") == pl.col("n_times"))
        known = times.filter(is_path)["object"].to_list()
        where = folder / _ORBITS
    shown = to_polars(truth.points).filter(pl.col("kind") == OBJECT)["source"].unique()
    if missing := sorted(set(shown.to_list()) - set(known)):
        raise DatasetError(
            f"{where}: no orbit of object {missing[0]}; expected its elements in scenario.json, "
            "or two rows or more at different times in orbits.parquet"
        )


def _read(path: Path, schema: pa.Schema) -> pa.Table:
    try:
        rows = pq.read_table(path, partitioning=None)
        for field in schema:  # another program's truth may not have all
            if field.nullable and field.name not in rows.column_names:
                rows = rows.append_column(field, pa.nulls(rows.num_rows, field.type))
        return conform(schema, rows)
    except (OSError, ValueError, pa.ArrowException) as error:
        raise DatasetError(f"{path}: cannot be read as truth: {error}") from error


def elements_of(truth: Truth) -> np.ndarray:
    """Return the (n, 6) orbital elements of the true objects at `t0_ns` [km and rad].

    NaN where the scenario has no elements of an object.
    """
    missing = [np.nan] * 6
    elements = [target.get("elements", missing) for target in truth.scenario["targets"]]
    return np.array(elements, float).reshape(-1, 6)

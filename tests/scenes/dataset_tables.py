"""Made-up nights of a dataset, for tests of storage."""

from pathlib import Path

import numpy as np
import pyarrow as pa

from epipole.schemas.columns import TIME
from epipole.schemas.tables import TABLES

DAY_NS = 86_400_000_000_000
FIRST_DAY = 17987  # 2019-04-01
NIGHT, NEXT_NIGHT = "2019-04-01", "2019-04-02"


def rows(schema: pa.Schema, times: np.ndarray, seed: int = 0) -> pa.Table:
    """Return a table with one made-up row per time."""
    rng = np.random.default_rng(seed)

    def values(field: pa.Field) -> pa.Array:
        if field.type == TIME:
            return pa.array(times, pa.int64()).cast(TIME)
        if pa.types.is_list(field.type):
            return pa.array([["one", "two"]] * len(times), field.type)
        if field.type == pa.string():
            return pa.array([f"s{i % 3}" for i in range(len(times))])
        return pa.array(rng.uniform(0, 100, len(times))).cast(field.type, safe=False)

    return pa.Table.from_arrays([values(field) for field in schema], schema=schema)


def night_tables(times: np.ndarray, logs: tuple[str, ...] = ("a",), seed: int = 0) -> dict:
    tables = {name: rows(schema, times, seed) for name, schema in TABLES.items()}
    first, last = int(times.min()), int(times.max())
    tables["sources"] = pa.Table.from_pylist(
        [
            {
                "name": f"{log}.mcap",
                "size": 1,
                "sha256": log * 64,
                "first_time": first,
                "last_time": last,
                "code_version": "0",
                "settings_key": "0",
            }
            for log in logs
        ],
        schema=TABLES["sources"],
    )
    return tables


# Not whole microseconds: Arrow cannot convert them to Python's datetime.
TIMES = FIRST_DAY * DAY_NS + np.arange(20) * 1_000_000_001 + 7
OVER_MIDNIGHT = (FIRST_DAY + 1) * DAY_NS + np.arange(-10, 10) * 1_000_000_001 + 7


def published(dataset: Path) -> dict[str, bytes]:
    """Return what readers of a dataset see: its nights, not what a run has staged."""
    files = contents(dataset).items()
    return {name: data for name, data in files if name.startswith("night=")}


def contents(dataset: Path) -> dict[str, bytes]:
    """Return all files of a dataset but reports, which name its folder, and records of runs."""
    files = [path for path in dataset.rglob("*") if path.is_file()]
    named = {str(path.relative_to(dataset)): path.read_bytes() for path in files}
    return {
        name: data for name, data in named.items() if not name.startswith(("reports/", "runs/"))
    }

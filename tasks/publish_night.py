"""Publish the night: what the stages found, as a dataset's tables."""

from collections.abc import Mapping, Sequence
from importlib.metadata import version

import numpy as np
import pyarrow as pa
from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.io.dataset import publish, rows_of_night
from epipole.schemas.bridge import array, concat, table
from epipole.schemas.log_tables import LogSource
from epipole.schemas.settings import Settings
from epipole.schemas.tables import REJECTS, SOURCES, TABLES
from epipole.tasks.retries import DELAYS_S, RETRIES, storage_failed

DAY_NS = 86_400_000_000_000


@task(
    name="publish night",
    cache_policy=NO_CACHE,
    retries=RETRIES,
    retry_delay_seconds=DELAYS_S,
    retry_condition_fn=storage_failed,
)
def publish_night(
    dataset: str,
    tables: Mapping[str, pa.Table],
    nights: Sequence[str],
    chosen: Sequence[str],
    replace: bool,
) -> dict[str, pa.Table]:
    """Publish the chosen nights, and return the rows that were published.

    Parameters
    ----------
    nights
        All nights that the logs have frames of.
    chosen
        Those of them that are asked for.
    """
    tables = dict(tables)
    tables["rejects"] = concat(REJECTS, [tables["rejects"], _outside(tables, nights)])
    tables["rejects"] = _into_nights(tables["rejects"], nights)
    publish(dataset, tables, chosen, replace)
    return {
        name: concat(TABLES[name], [rows_of_night(name, rows, night) for night in chosen])
        for name, rows in tables.items()
    }


def source_table(sources: Sequence[LogSource], settings: Settings) -> pa.Table:
    """Return the rows of `sources`: the logs, and by which code and settings they were run."""
    columns = {name: [getattr(s, name) for s in sources] for name in ("name", "size", "sha256")}
    return table(
        SOURCES,
        {
            **columns,
            "first_time": np.array([s.first_time_ns for s in sources], np.int64),
            "last_time": np.array([s.last_time_ns for s in sources], np.int64),
            "code_version": [version("epipole")] * len(sources),
            "settings_key": [settings.key()] * len(sources),
        },
    )


def _outside(tables: Mapping[str, pa.Table], nights: Sequence[str]) -> pa.Table:
    """Return a reject for the rows that fall beside the nights the logs have frames of.

    An epoch on the other side of midnight from its frames belongs to a night that these logs
    do not make.
    """
    names, times, counts = [], [], []
    for name, rows in tables.items():
        inside = [rows_of_night(name, rows, night).num_rows for night in nights]
        if name in ("calibrations", "sources", "rejects") or sum(inside) == rows.num_rows:
            continue
        names.append(name)
        times.append(_start_ns(nights[0]))
        counts.append(rows.num_rows - sum(inside))
    return table(
        REJECTS,
        {
            "source": [None] * len(names),
            "offset": [None] * len(names),
            "sensor_id": [None] * len(names),
            "time": np.array(times, np.int64),
            "stage": ["publish_night"] * len(names),
            "reason": [f"{name}_outside_nights" for name in names],
            "count": counts,
        },
    )


def _into_nights(rejects: pa.Table, nights: Sequence[str]) -> pa.Table:
    """Return the rejects with those of no night at the start of the nearest, so none is lost."""
    time_ns = array(rejects, "time")
    starts = np.array([_start_ns(night) for night in nights])
    day = time_ns // DAY_NS * DAY_NS
    nearest = starts[np.argmin(np.abs(day[:, None] - starts), axis=1)]
    time_ns = np.where(np.isin(day, starts), time_ns, nearest)
    at = rejects.column_names.index("time")
    return rejects.set_column(
        at, REJECTS.field("time"), pa.array(time_ns).cast(REJECTS.field("time").type)
    )


def _start_ns(night: str) -> int:
    return int(np.datetime64(night, "ns").astype(np.int64))

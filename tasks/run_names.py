"""Names of task runs on Prefect's page: of which sensor, from when to when."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pyarrow as pa

from epipole.schemas.bridge import array


def sensor_and_span(verb: str, rows: str) -> Callable[..., str]:
    """Return what names a task's run after a parameter, such as ``identify sat3 04:00-04:10``.

    Parameters
    ----------
    rows
        The task's parameter, a table of one sensor with a column `time`. UTC, whole minutes
        around its rows; a table without rows or times gives what it can.
    """

    def name(parameters: dict[str, Any]) -> str:
        table: pa.Table = parameters[rows]
        if not table.num_rows:
            return verb
        sensor_id = table["sensor_id"][0].as_py()
        return f"{verb} {sensor_id} {_span(array(table, 'time'))}"

    return name


def _span(time_ns: np.ndarray) -> str:
    minute_ns = 60_000_000_000
    first = np.datetime64(int(time_ns.min()) // minute_ns, "m")
    last = np.datetime64(-(-(int(time_ns.max()) + 1) // minute_ns), "m")
    return f"{first.item():%H:%M}-{last.item():%H:%M}"

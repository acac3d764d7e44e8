"""Tables published as nights of a dataset, the way a run publishes them."""

from collections.abc import Mapping, Sequence

import pyarrow as pa

from epipole.io.datasets.dataset import (
    Where,
    lock_nights,
    publish_folders,
)
from epipole.io.datasets.night_tables import write_table
from epipole.io.datasets.rows_by_night import in_order, rows_of_night
from epipole.schemas.bridge import empty
from epipole.schemas.tables import TABLES


def publish(
    dataset: Where, tables: Mapping[str, pa.Table], nights: Sequence[str], replace: bool = False
) -> None:
    """Publish these nights of the tables; a table that is missing has no rows.

    Rows of other nights are not written. Errors are those of `publish_folders`.
    """
    with lock_nights(dataset, []) as work:
        staged = {night: work / f"night={night}" for night in nights}
        for night, folder in staged.items():
            for name, schema in TABLES.items():
                rows = rows_of_night(name, tables.get(name, empty(schema)), night)
                write_table(folder, name, [in_order(rows)])
        publish_folders(dataset, staged, tables["sources"], replace)

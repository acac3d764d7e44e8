"""Details of objects: light curves, residuals by sensor, and orbits with their sigmas."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import polars as pl

from epipole.io.datasets.night_tables import NightReader

MAX_DETAILED = 40  # objects
MAX_DOTS = 1600  # of all objects in a kind of picture: a page below 1.5 MB has no room for more
ELEMENTS = (
    "a_km", "e", "i_deg", "raan_deg", "argp_deg", "mean_anomaly_deg", "longitude_deg",
    "drift_deg_day",
)  # fmt: skip
_ORBIT = ["object_id", "epoch", "cov_xx", "cov_yy", "cov_zz", "n_observations", "arc_s", "chi2",
          "dof", "forces", *ELEMENTS, *(f"sigma_{name}" for name in ELEMENTS)]  # fmt: skip
SEEN = ["time", "sensor_id", "frame_number", "magnitude_1000_km", "magnitude", "magnitude_sigma",
        "residual_sigma", "sunlit"]  # fmt: skip


class ObjectDetail(NamedTuple):
    """An object more closely.

    orbit : its row of `orbits`; None: no orbit
    seen : some of its rows of `observations`, columns `SEEN`
    step : every how many of them
    by_sensor : a row per sensor: sensor_id, count, and the mean square of residual_sigma,
        which should be 2
    """

    object_id: str
    orbit: dict[str, Any] | None
    seen: pl.DataFrame
    step: int
    by_sensor: pl.DataFrame

    def thinned(self, every: int) -> "ObjectDetail":
        """Return it with every n-th of its observations."""
        return self._replace(seen=self.seen.gather_every(every), step=self.step * every)


def read_object_details(night: NightReader, object_ids: Sequence[str]) -> list[ObjectDetail]:
    """Return the details of these objects, in their order."""
    counts = night.read("objects", ["object_id", "n_observations"])
    number = dict(counts.iter_rows())
    allowed = max(MAX_DOTS // max(len(object_ids), 1), 1)
    steps = {name: max(-(-number.get(name, 0) // allowed), 1) for name in object_ids}
    rows, sums = _observations(night, steps)
    orbits = {row["object_id"]: row for row in night.read("orbits", _ORBIT).to_dicts()}
    return [
        ObjectDetail(
            name, orbits.get(name), rows.filter(object_id=name).drop("object_id"), steps[name],
            sums.filter(object_id=name).drop("object_id").sort("sensor_id"),
        )
        for name in object_ids
    ]  # fmt: skip


def _observations(night: NightReader, steps: dict[str, int]) -> tuple[pl.DataFrame, pl.DataFrame]:
    """Return every n-th observation of each object, and sums over all, by object and sensor."""
    columns = ["object_id", *SEEN]
    kept, sums = [], []
    key = ["object_id", "sensor_id"]
    step = pl.col("object_id").replace_strict(steps, default=1, return_dtype=pl.Int64)
    for rows in (night.empty("observations", columns), *night.pieces("observations", columns)):
        chosen = rows.filter(pl.col("object_id").is_in(list(steps)))
        kept.append(chosen.filter(pl.int_range(pl.len()).over("object_id") % step == 0))
        sums.append(chosen.group_by(key).agg(
            pl.len().alias("count"), fitted=pl.col("residual_sigma").count(),
            square=(pl.col("residual_sigma") ** 2).sum(),
        ))  # fmt: skip
    total = pl.concat(sums).group_by(key).sum()
    known = pl.when(pl.col("fitted") > 0)
    total = total.select(*key, "count", mean_square=known.then(pl.col("square") / pl.col("fitted")))
    return pl.concat(kept), total

"""Sensor residuals: how far a sensor's detections of known objects are from their predictions.

A late clock moves all objects back along their tracks; a wrong ephemeris moves them together. This
needs no other sensor, so it also shows an error that all sensors share.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import polars as pl

from epipole.io.datasets.night_tables import read_columns, take_rows
from epipole.schemas.arrays import Array
from epipole.schemas.columns import POSITION, VELOCITY
from epipole.schemas.star_lists import ElementSet
from epipole.tasks.algorithms.known_objects.matching import spread_rows
from epipole.tasks.algorithms.known_objects.prediction import (
    predict,
    satellites_of,
    track_residuals,
)

AXES = ("along", "across")


@dataclass(frozen=True)
class SensorResidual:
    """Observed minus predicted position of a sensor's known objects, at their distance [km].

    Mean and scatter are over the objects, of the means over their detections. The scatter of a
    single object is NaN.
    """

    sensor_id: str
    objects: int
    along_km: float
    along_scatter_km: float
    across_km: float
    across_scatter_km: float

    def __str__(self) -> str:
        """Return a line of the summary."""
        axes = (
            f"{axis} {mean:+.2f}" + (f" +- {scatter:.2f} km" if self.objects > 1 else " km")
            for axis, mean, scatter in (
                ("along", self.along_km, self.along_scatter_km),
                ("across", self.across_km, self.across_scatter_km),
            )
        )
        return f"{self.sensor_id}: {', '.join(axes)}"


def sensor_residuals(folder: Path, known: Mapping[str, ElementSet]) -> list[SensorResidual]:
    """Return the residuals of each sensor that has detections of known objects.

    Parameters
    ----------
    folder
        The night's folder; its `observations` are written.
    known
        Elements of objects, by their ids.
    """
    columns = ["sensor_id", "object_id", "time"]
    index = pl.DataFrame(read_columns(folder, "observations", columns)).with_row_index("row")
    index = index.filter(pl.col("object_id").is_in(list(known)))
    chosen = [np.zeros(0, np.int64)]
    for rows in index.partition_by("sensor_id", "object_id", maintain_order=True):
        times = rows["time"].cast(pl.Int64).to_numpy()
        spread = spread_rows(times, np.ones(len(times), bool))
        chosen.append(rows["row"].to_numpy()[spread].astype(np.int64))
    columns += ["ra_deg", "dec_deg", *POSITION, *VELOCITY]
    seen = pl.DataFrame(take_rows(folder, "observations", columns, np.sort(np.concatenate(chosen))))
    residuals = [
        _with_residuals(rows, known[rows["object_id"][0]])
        for rows in seen.partition_by("object_id", maintain_order=True)
    ]
    if not residuals:
        return []
    means = pl.concat(residuals).group_by("sensor_id", "object_id").agg(pl.col(*AXES).mean())
    return [
        _of_sensor(rows["sensor_id"][0], rows.select(AXES).to_numpy())
        for rows in means.sort("sensor_id", "object_id").partition_by("sensor_id")
    ]


def _with_residuals(seen: pl.DataFrame, elements: ElementSet) -> pl.DataFrame:
    """Return the observations of one object with their residuals along and across its track."""
    satellites = satellites_of(np.array([elements.elements]))
    states = predict(satellites, seen["time"].cast(pl.Int64).to_numpy())[0]
    residuals = track_residuals(
        np.radians(seen.select("ra_deg", "dec_deg").to_numpy()),
        seen.select(POSITION).to_numpy(),
        np.nan_to_num(seen.select(VELOCITY).to_numpy().astype(float)),
        states,
    )
    found = seen.select("sensor_id", "object_id", **dict(zip(AXES, residuals.T, strict=True)))
    return found.drop_nans()


def _of_sensor(sensor_id: str, means: Array) -> SensorResidual:
    along, across = means.mean(axis=0)
    along_scatter, across_scatter = (
        means.std(axis=0, ddof=1) if len(means) > 1 else (np.nan, np.nan)
    )
    return SensorResidual(
        sensor_id, len(means), float(along), float(along_scatter), float(across),
        float(across_scatter),
    )  # fmt: skip

"""One frame as a map: its stars with names, their residuals, and what is no star."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl

from epipole.io.datasets.night_reader import NightReader
from epipole.tasks.report.frame_series import FrameSeries

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

SEARCHED_NS = 120_000_000_000  # of the night's middle
MOST_OTHERS = 300


class StarMap(NamedTuple):
    """A frame.

    star_id, magnitude : (n,)
    stars_px, residuals_px : (n, 2) places and residuals of its stars
    others_px : (m, 2) detections that are no stars, the brightest
    objects : (m,) which of them belong to a track
    """

    sensor_id: str
    frame_number: int
    time_ns: int
    star_id: Indices
    magnitude: Array
    stars_px: Array
    residuals_px: Array
    others_px: Array
    objects: npt.NDArray[np.bool_]


def read_star_map(night: NightReader, series: FrameSeries) -> StarMap | None:
    """Return a frame near the middle of the night with as many stars as is usual for its sensor.

    It is of the sensor with the most identified frames. None: no frame is identified.
    """
    identified = series.counts[0]
    if not identified.sum():
        return None
    k = int(np.argmax(identified.sum(axis=1)))
    held = np.flatnonzero(identified[k])
    bin_ = int(held[np.argmin(np.abs(held - series.bins.number / 2))])
    frame = _usual_frame(night, series, k, bin_)
    if frame is None:
        return None
    number, time_ns = frame
    own = (pl.col("sensor_id") == series.sensors[k]) & (pl.col("frame_number") == number)
    columns = ["time", "sensor_id", "frame_number", "x_px", "y_px"]
    stars = _rows(night, "stars", [*columns, "star_id", "magnitude", "dx_px", "dy_px"], time_ns)
    others = _rows(night, "detections", [*columns, "flux", "track_id"], time_ns).filter(own)
    others = others.sort("flux", descending=True, nulls_last=True, maintain_order=True)
    others, stars = others.head(MOST_OTHERS), stars.filter(own)
    return StarMap(
        series.sensors[k], number, time_ns,
        stars["star_id"].to_numpy(), stars["magnitude"].to_numpy(),
        stars.select("x_px", "y_px").to_numpy(), stars.select("dx_px", "dy_px").to_numpy(),
        others.select("x_px", "y_px").to_numpy(), others["track_id"].is_not_null().to_numpy(),
    )  # fmt: skip


def _usual_frame(
    night: NightReader, series: FrameSeries, k: int, bin_: int
) -> tuple[int, int] | None:
    """Return number and time of the frame whose number of stars is nearest to the mean."""
    length = (series.bins.end_ns - series.bins.start_ns) / series.bins.number
    start = series.bins.start_ns + int(bin_ * length)
    best: tuple[float, int, int] | None = None
    columns = ["time", "sensor_id", "frame_number", "attitude_source", "n_stars"]
    for searched in (min(int(length) + 1, SEARCHED_NS), int(length) + 2):
        for rows in night.pieces("frames", columns, (start, start + searched)):
            own = rows.filter(sensor_id=series.sensors[k], attitude_source="stars")
            off = np.abs(own["n_stars"].to_numpy() - series.stars[k])
            if len(own) and (best is None or off.min() < best[0]):
                at = int(np.argmin(off))
                time_ns = int(own["time"].dt.epoch("ns")[at])
                best = float(off[at]), int(own["frame_number"][at]), time_ns
        if best is not None:
            return best[1:]
    return None


def _rows(night: NightReader, table: str, columns: list[str], time_ns: int) -> pl.DataFrame:
    pieces = list(night.pieces(table, columns, (time_ns, time_ns + 1)))
    return pl.concat(pieces) if pieces else night.empty(table, columns)

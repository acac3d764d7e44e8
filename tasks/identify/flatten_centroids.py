"""Flatten centroids: the centroid lists of one sensor's frames as arrays, with directions."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import array, flatten
from epipole.schemas.settings import Settings
from epipole.tasks.algorithms.geometry.camera import Camera, inside, pixel_angle, unproject

Array = npt.NDArray[np.float64]


class FlatCentroids(NamedTuple):
    """All centroids of one sensor's frames, one after another.

    Frame k has the centroids ``first[k]:first[k + 1]``. Cameras are named by their row in
    `cameras`; -1 where a frame has none.
    """

    first: npt.NDArray[np.int64]
    frame: npt.NDArray[np.int64]
    x_px: Array
    y_px: Array
    flux: Array
    sigma_px: Array  # NaN where unknown
    u: Array  # sensor axes
    pixel_rad: Array
    in_image: npt.NDArray[np.bool_]  # of the frame's camera; false without one
    camera_of_frame: npt.NDArray[np.int64]
    cameras: dict[int, Camera]


def flatten_centroids(exposures: pa.Table, cameras: pa.Table, settings: Settings) -> FlatCentroids:
    """Return the centroids of one sensor's frames, with the valid cameras."""
    x_px, first = flatten(exposures, "x_px")
    y_px, _ = flatten(exposures, "y_px")
    frame = np.repeat(np.arange(exposures.num_rows), np.diff(first))
    sigma_px = _optional(exposures, "sigma_px", len(x_px))
    if settings.sensors.centroid_sigma_px is not None:
        sigma_px = np.where(np.isnan(sigma_px), settings.sensors.centroid_sigma_px, sigma_px)
    camera_of_frame, used = _cameras_of(exposures, cameras)
    u, pixel_rad = np.zeros((len(x_px), 3)), np.ones(len(x_px))
    in_image = np.zeros(len(x_px), np.bool_)
    for row, camera in used.items():
        at = camera_of_frame[frame] == row
        u[at] = unproject(camera, x_px[at], y_px[at])
        pixel_rad[at] = pixel_angle(camera, u[at])
        in_image[at] = inside(camera, x_px[at], y_px[at])
    flux = _optional(exposures, "flux", len(x_px))
    return FlatCentroids(
        first, frame, x_px, y_px, flux, sigma_px, u, pixel_rad, in_image, camera_of_frame, used
    )


def _optional(exposures: pa.Table, name: str, n: int) -> Array:
    """Return a list column as one array; NaN where a list is null or a value not positive."""
    _, first = flatten(exposures, "x_px")
    known, first_known = flatten(exposures, name)
    values = np.full(n, np.nan)
    values[np.repeat(np.diff(first_known) > 0, np.diff(first))] = known
    values[~(values > 0)] = np.nan
    return values


def _cameras_of(
    exposures: pa.Table, cameras: pa.Table
) -> tuple[npt.NDArray[np.int64], dict[int, Camera]]:
    """Return the row of `cameras` that is valid for each frame (-1: none), and those cameras."""
    rows = np.flatnonzero(array(cameras, "sensor_id") == exposures["sensor_id"][0].as_py())
    if len(rows) == 0:
        return np.full(exposures.num_rows, -1), {}
    times = array(cameras, "time")[rows]
    rows = rows[np.argsort(times, kind="stable")]
    newest = np.searchsorted(np.sort(times), array(exposures, "time"), side="right") - 1
    holds = rows[np.maximum(newest, 0)]
    used = np.unique(holds)
    values = [cameras.select(list(Camera._fields)).slice(int(r), 1).to_pylist()[0] for r in used]
    return holds, {int(r): Camera(**v) for r, v in zip(used, values, strict=True)}

"""Centroids that stay at one pixel: hot pixels, where the sky moves over the image."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# A centroid stays if a pixel shows one in so many frames at least, and in this share of all.
FEWEST_FRAMES, SHARE = 4, 0.3


def static_centroids(
    first: npt.NDArray[np.int64], x_px: Array, y_px: Array
) -> npt.NDArray[np.bool_]:
    """Return which centroids of a sensor's frames lie where many of its frames have one.

    So do stars where the sensor stares at one place of the sky: the caller decides.

    Parameters
    ----------
    first : (F + 1,) int64
        Frame k has the centroids first[k]:first[k + 1].
    x_px, y_px : (N,) float
        Places; one that is not finite does not stay.
    """
    n_frames = len(first) - 1
    least = max(FEWEST_FRAMES, int(np.ceil(SHARE * n_frames)))
    frame = np.repeat(np.arange(n_frames), np.diff(first))
    stays = np.zeros(len(x_px), np.bool_)
    at = np.flatnonzero(np.isfinite(x_px) & np.isfinite(y_px))
    for shift in (0.0, 0.5):  # a place on the border of two pixels lies in the middle of another
        cell = _cells(x_px[at] + shift, y_px[at] + shift)
        once = np.unique(cell * n_frames + frame[at]) // n_frames
        cells, frames = np.unique(once, return_counts=True)
        stays[at] |= np.isin(cell, cells[frames >= least])
    return stays


def _cells(x_px: Array, y_px: Array) -> npt.NDArray[np.int64]:
    """Return a number for each pixel."""
    column, row = (np.clip(np.floor(v), -1e6, 1e6).astype(np.int64) for v in (x_px, y_px))
    return (column + 1_000_000) * 4_000_000 + row + 1_000_000

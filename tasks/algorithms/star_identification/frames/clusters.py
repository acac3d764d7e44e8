"""Clusters of false centroids: a reflection, a bright object's halo, a damaged part of the chip."""

import numpy as np
import numpy.typing as npt

Rows = npt.NDArray[np.int64]

CELLS = 8  # along each side of the image
# A cell may hold so many centroids, or so many times as many as the median cell.
FEW, TIMES = 4, 3


def thinned(u: npt.NDArray[np.float64], box: npt.NDArray[np.float64]) -> Rows:
    """Return the rows of centroids without most of those of crowded cells.

    Parameters
    ----------
    u : (n, 3) float
        Directions in the sensor frame, brightest first: the brightest of a cell are kept.
    box : (4,) float
        x0, x1, y0, y1 of the image in normalised coordinates.
    """
    at = (u[:, :2] / u[:, 2:] - box[[0, 2]]) / (box[[1, 3]] - box[[0, 2]])
    row, column = np.clip(CELLS * at, 0, CELLS - 1).astype(np.int64).T
    cell = row * CELLS + column
    count = np.bincount(cell, minlength=CELLS * CELLS)
    order = np.argsort(cell, kind="stable")
    rank = np.empty(len(cell), np.int64)
    rank[order] = np.arange(len(cell)) - (np.cumsum(count) - count)[cell[order]]
    return np.flatnonzero(rank < max(FEW, TIMES * np.median(count)))

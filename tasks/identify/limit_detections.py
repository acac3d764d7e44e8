"""Bound detections: of a sensor that reports more than can be followed, which ones are kept."""

import numpy as np
import numpy.typing as npt

Flags = npt.NDArray[np.bool_]


def within_limit(frame: npt.NDArray[np.int64], flux: npt.NDArray[np.float64], most: int) -> Flags:
    """Return which detections are kept, so that there are at most `most`.

    The fullest frames are cut to one number, and keep their brightest. Frames with fewer keep all.

    Parameters
    ----------
    frame : (n,) int
        Frame of each detection, ascending.
    flux : (n,) float
        NaN where unknown: these are cut first, the later ones of a frame before the earlier.
    """
    counts = np.bincount(frame)
    if len(frame) <= most:
        return np.ones(len(frame), bool)
    order = np.lexsort((-np.nan_to_num(flux, nan=-np.inf), frame))
    rank = np.empty(len(frame), np.int64)
    rank[order] = np.arange(len(frame)) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.asarray(rank < _most_per_frame(counts, most))


def _most_per_frame(counts: npt.NDArray[np.int64], most: int) -> int:
    """Return the largest number per frame with which all frames together have at most `most`."""
    low, high = 0, int(counts.max())
    while low < high:
        middle = (low + high + 1) // 2
        if np.minimum(counts, middle).sum() <= most:
            low = middle
        else:
            high = middle - 1
    return low

"""Choose instants: the few epochs of a window at which its tracklets are compared."""

from collections.abc import Iterable

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import array

Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

MOST_SAMPLES = 12  # instants in a window
BLENDED = 4.0  # times the noise: what blends may add makes a view useless to tell objects apart


def clear_views(views: pa.Table) -> Flags:
    """Return which VIEWS tell objects apart: blends add little to their variance.

    The direction of the others may be of one object or of its neighbour. A group that is found
    without them has them as well. A tracklet that is a blend throughout is judged by its best
    views.
    """
    blend = 2 * array(views, "blend_rad2")
    noise = array(views, "cov_noise_11_rad2") + array(views, "cov_noise_22_rad2") - blend
    shared = array(views, "cov_bias_11_rad2") + array(views, "cov_bias_22_rad2")
    return np.asarray(blend <= BLENDED * np.maximum(noise, shared))


def even_instants(epochs: Indices, window_s: float) -> Indices:
    """Return a few of the epochs, evenly spaced and far enough apart to be independent.

    Parameters
    ----------
    epochs
        Distinct, in order [ns].
    window_s
        A view rests on detections within this time of its epoch: two epochs within twice this
        time share detections.
    """
    if not len(epochs):
        return epochs
    step = 2 * window_s * 1e9
    n = min(int(max((epochs[-1] - epochs[0]) // step, 1)), MOST_SAMPLES)
    edges = np.linspace(epochs[0], epochs[-1], n + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    return np.unique(epochs[np.argmin(np.abs(epochs[:, None] - middle), axis=0)])


def with_extra_instants(even: Indices, tracklets: Iterable[Indices]) -> Indices:
    """Return the instants of a window, with one for each tracklet without a view at these.

    Parameters
    ----------
    tracklets
        For each tracklet without a clear view at the even instants, in order: the epochs of its
        clear views. It gets the middle one, unless it has a view at the instant of another.
    """
    chosen = set(even.tolist())
    for epochs in tracklets:
        if len(chosen) >= MOST_SAMPLES:
            break
        if len(epochs) and not chosen.intersection(epochs.tolist()):
            chosen.add(int(epochs[len(epochs) // 2]))
    return np.array(sorted(chosen), np.int64)

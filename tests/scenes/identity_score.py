"""IDF1 of tracks against the truth."""

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment

Labels = npt.NDArray[np.int64]


def identity_f1(truth: Labels, found: Labels) -> float:
    """Return IDF1: how well tracks and objects agree, one track per object.

    Parameters
    ----------
    truth, found : (n,) int
        The true object of each detection and the track it was given; -1 where there is none.

    References
    ----------
    Ristani et al. (2016), Performance measures and a data set for multi-target, multi-camera
    tracking: 2 IDTP / (2 IDTP + IDFP + IDFN) under the best one-to-one matching.
    """
    both = (truth >= 0) & (found >= 0)
    objects, row = np.unique(truth[both], return_inverse=True)
    tracks, column = np.unique(found[both], return_inverse=True)
    shared = np.zeros((len(objects), len(tracks)), np.int64)
    np.add.at(shared, (row, column), 1)
    idtp = shared[linear_sum_assignment(shared, maximize=True)].sum()
    return float(2 * idtp / max((truth >= 0).sum() + (found >= 0).sum(), 1))

"""Detection: how likely sensors are to have what they look at, as the sure groups tell."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.evidence.pool import Hypothesis
from epipole.tasks.algorithms.association.sampling.views import Views

Array = npt.NDArray[np.float64]

CERTAIN_LOG_ODDS = 8.0  # of a group that tells
OTHERS, OTHERS_AT_ONCE = 3, 4  # sensors that have it, at several instants and at a single one
PRIOR_LOOKS = 10.0  # as good as so many looks does the prior count, and all sensors for each
LEAST, MOST = 0.05, 0.99


def detection_odds(looks: Array, detected: Array) -> Array:
    """Return the log-probability of who has an object and who looks and has it not, (n,).

    `looks` (n, s): 1 where the sensor has it, -1 where it looks in vain, else 0.
    """
    total = (looks > 0) @ np.log(detected) + (looks < 0) @ np.log(1 - detected)
    return np.asarray(total, float)


def estimated_detection(views: Views, groups: Sequence[Hypothesis], prior: float) -> Array:
    """Return each sensor's probability of detection, (s,).

    Every sensor is asked about the sure groups that enough others have: these are found whether
    it has them or not, so it does not matter that an object which few have rarely is. Hits over
    looks, drawn to what all sensors have, and that to `prior`.
    """
    n_sensors = len(views.half_field)
    looks = np.array([h.looks for h in groups], np.int8).reshape(-1, n_sensors)
    has = looks > 0
    others = has.sum(axis=1)[:, None] - has
    asked = (looks != 0) & (others >= (OTHERS if len(views.time_s) > 1 else OTHERS_AT_ONCE))
    looked, hits = asked.sum(axis=0), (asked & has).sum(axis=0)
    common = (hits.sum() + PRIOR_LOOKS * prior) / (looked.sum() + PRIOR_LOOKS)
    return np.clip((hits + PRIOR_LOOKS * common) / (looked + PRIOR_LOOKS), LEAST, MOST)

"""Detection: the probability that a sensor detects an object in its field, from sure groups."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.evidence.pool import Hypothesis
from epipole.tasks.algorithms.association.sampling.views import Views

Array = npt.NDArray[np.float64]

CERTAIN_LOG_ODDS = 8.0  # of a sure group
# Other sensors that must detect an object: at several instants, and at a single one.
OTHERS, OTHERS_AT_ONCE = 3, 4
PRIOR_LOOKS = 10.0  # weight of the prior, as a number of looks
LEAST, MOST = 0.05, 0.99


def detection_odds(outcomes: Array, detected: Array) -> Array:
    """Return the log-probability of the detections and misses of objects, (n,).

    `outcomes` (n, s): 1 for a detection, -1 for a miss, 0 for a sensor without the object in its
    field.
    """
    total = (outcomes > 0) @ np.log(detected) + (outcomes < 0) @ np.log(1 - detected)
    return np.asarray(total, float)


def estimated_detection(views: Views, groups: Sequence[Hypothesis], prior: float) -> Array:
    """Return each sensor's probability of detection, (s,).

    Each sensor is judged by the sure groups that enough other sensors detect. Such groups are
    found whether this sensor detects them or not, so the estimate is not biased by objects that
    are too weak to be found. Detections over looks, shrunk towards the mean of all sensors,
    which is shrunk towards `prior`.
    """
    n_sensors = len(views.half_field)
    outcomes = np.array([h.outcomes for h in groups], np.int8).reshape(-1, n_sensors)
    has = outcomes > 0
    others = has.sum(axis=1)[:, None] - has
    asked = (outcomes != 0) & (others >= (OTHERS if len(views.time_s) > 1 else OTHERS_AT_ONCE))
    looked, hits = asked.sum(axis=0), (asked & has).sum(axis=0)
    common = (hits.sum() + PRIOR_LOOKS * prior) / (looked.sum() + PRIOR_LOOKS)
    return np.clip((hits + PRIOR_LOOKS * common) / (looked + PRIOR_LOOKS), LEAST, MOST)

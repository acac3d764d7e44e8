"""Detection: how likely sensors are to have what they look at, as the sure groups tell."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.chance import Chance
from epipole.tasks.algorithms.association.pool import Hypothesis
from epipole.tasks.algorithms.association.views import SPOT_SR, Views

Array = npt.NDArray[np.float64]

CERTAIN_LOG_ODDS = 8.0  # of a group that tells, even without the view of the sensor asked about
PRIOR_LOOKS = 10.0  # as good as so many looks does the prior count, and all sensors for each
LEAST, MOST = 0.05, 0.99


def detection_odds(looks: Array, detected: Array) -> Array:
    """Return the log-probability of who has an object and who looks and has it not, (n,).

    `looks` (n, s): 1 where the sensor has it, -1 where it looks in vain, else 0.
    """
    total = (looks > 0) @ np.log(detected) + (looks < 0) @ np.log(1 - detected)
    return np.asarray(total, float)


def estimated_detection(
    views: Views, chance: Chance, groups: Sequence[Hypothesis], prior: float
) -> Array:
    """Return each sensor's probability of detection, (s,).

    Every sensor is asked about the groups that would be certain without it: so it does not
    matter that an object which few have is rarely found. Hits over looks, drawn to what all
    sensors have, and that to `prior`.
    """
    n_sensors = len(views.half_field)
    hits, looked = np.zeros(n_sensors), np.zeros(n_sensors)
    several = 1.0 if len(views.time_s) == 1 else 2.0  # a tracklet's drift is worth its place
    for h in groups:
        members = np.array(h.members)
        looks = np.array(h.looks)
        own = views.sensor[members]
        worth = np.zeros(n_sensors)
        m = views.seen[members].argmax(axis=1)
        worth[own] = -several * np.log(chance.density[own] * views.sight[members, m, SPOT_SR])
        without = h.score - (looks > 0) * (worth + np.log(chance.detected / (1 - chance.detected)))
        asked = (looks != 0) & (without > CERTAIN_LOG_ODDS)
        looked += asked
        hits += asked & (looks > 0)
    common = (hits.sum() + PRIOR_LOOKS * prior) / (looked.sum() + PRIOR_LOOKS)
    return np.clip((hits + PRIOR_LOOKS * common) / (looked + PRIOR_LOOKS), LEAST, MOST)

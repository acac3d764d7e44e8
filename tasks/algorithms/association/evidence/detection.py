"""Detection: the probability that a sensor detects an object in its field, from sure groups."""

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.evidence.hypothesis_queue import Hypothesis
from epipole.tasks.algorithms.association.sampling.views import Views

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

CERTAIN_LOG_ODDS = 8.0  # of a sure group
# Other sensors that must detect an object: at several instants, and at a single one.
OTHERS, OTHERS_AT_ONCE = 3, 4
PRIOR_LOOKS = 10.0  # weight of the prior, as a number of looks
LEAST, MOST = 0.05, 0.99


class Looks(NamedTuple):
    """Sensors that detect an object or miss it, one row for each object and sensor.

    row, sensor : (n,) int
        The object and the sensor.
    hit : (n,) bool
        The sensor detects it.
    """

    row: Indices
    sensor: Indices
    hit: Flags


def looks_of(views: Views, objects: Sequence[Hypothesis]) -> Looks:
    """Return which sensors detect or miss the objects."""
    member = np.fromiter(chain.from_iterable(h.members for h in objects), np.int64)
    row = np.repeat(np.arange(len(objects)), [len(h.members) for h in objects])
    # A sensor may have several fragments of an object. Members are in order, so these are in turn.
    sensor = views.sensor[member]
    other = np.ones(len(row), np.bool_)
    other[1:] = (row[1:] != row[:-1]) | (sensor[1:] != sensor[:-1])
    row, sensor = row[other], sensor[other]
    missed_row = np.repeat(np.arange(len(objects)), [len(h.missed) for h in objects])
    missed = np.concatenate([*(h.missed for h in objects), np.zeros(0, np.int64)])
    return Looks(
        np.concatenate([row, missed_row]),
        np.concatenate([sensor, missed]),
        np.arange(len(row) + len(missed)) < len(row),
    )


def detection_odds(looks: Looks, n: int, detected: Array) -> Array:
    """Return the log-probability of the detections and misses of n objects."""
    odds = np.log(np.where(looks.hit, detected[looks.sensor], 1 - detected[looks.sensor]))
    return np.bincount(looks.row, odds, minlength=n).astype(float)


def estimated_detection(views: Views, groups: Sequence[Hypothesis], prior: float) -> Array:
    """Return each sensor's probability of detection, (s,).

    Each sensor is judged by the sure groups that enough other sensors detect. Such groups are
    found whether this sensor detects them or not, so the estimate is not biased by objects that
    are too weak to be found. Detections over looks, shrunk towards the mean of all sensors,
    which is shrunk towards `prior`.
    """
    n_sensors = len(views.half_field)
    row, sensor, hit = looks_of(views, groups)
    others = np.bincount(row[hit], minlength=len(groups))[row] - hit
    asked = others >= (OTHERS if len(views.time_s) > 1 else OTHERS_AT_ONCE)
    looked = np.bincount(sensor[asked], minlength=n_sensors)
    hits = np.bincount(sensor[asked & hit], minlength=n_sensors)
    common = (hits.sum() + PRIOR_LOOKS * prior) / (looked.sum() + PRIOR_LOOKS)
    return np.clip((hits + PRIOR_LOOKS * common) / (looked + PRIOR_LOOKS), LEAST, MOST)

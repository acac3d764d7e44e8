"""How unrelated tracklets behave and how many objects there are, estimated from the data.

The odds of a hypothesis need three estimates, in the order in which a search makes them:

1. `chance_of`, before anything is associated: density and motion of each sensor's tracklets.
2. `estimated_detection`, from certain groups: each sensor's probability of detection.
3. `revised_odds`, from all groups: the number of objects in each altitude shell, and with it the
   groups' final log-odds.

The third one is empirical Bayes. The search assumes that every tracklet may be an object, and the
altitude prior as stated. The certain groups show how many objects the visible volume really holds
and at which altitudes. The count of each shell is Poisson; its rate has a gamma prior about the
rate common to all shells.
"""

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.hypothesis_queue import Hypothesis
from epipole.tasks.algorithms.association.odds import in_view
from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.association.views import Views
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.kernels import kernel

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]
CERTAIN_LOG_ODDS = 8.0  # log-odds from which a group is certain
# Minimum number of other sensors that detect an object: with several instants, with a single one.
OTHERS, OTHERS_AT_ONCE = 3, 4
PRIOR_LOOKS = 10.0  # weight of the prior, as a number of detections and misses
MIN_DETECTION, MAX_DETECTION = 0.05, 0.99
SIGHTS = 100  # lines of sight that sample all fields; beyond 100 sensors, one in each of 100 fields
STEPS = 24  # along a line of sight, in addition to the shells' edges
MAX_RATE_RATIO = 10.0  # maximum rate of a shell over the common rate
PRIOR_OBJECTS = 1.0  # weight of the prior of a shell, as a number of objects
ROUNDS = 100  # maximum number of iterations of `revised_odds`
# 1-sigma per axis of the rates of unrelated objects, seen from a low orbit [rad/s]: 900 arcsec/s.
# Counts as one tracklet. In two simulated constellations the medians were 1,600 and 2,900 arcsec/s.
USUAL_SPREAD = 900 * ARCSEC
MIN_SPREAD = 10 * ARCSEC  # rad/s; a prior for sensors whose tracklets move alike


class Chance(NamedTuple):
    """Tracklets of each of s sensors as a random process.

    density : (s,) float
        Tracklets per steradian.
    drift : (s, 3) float
        Median rate of their directions [1/s].
    spread : (s,) float
        Spread of their rates, 1-sigma per axis [rad/s].
    objects_in_view, objects_km3 : float
        Largest number of objects in view, and the same per km^3.
    detected : (s,) float
        Probability that a sensor detects an object in its field.
    """

    density: Array
    drift: Array
    spread: Array
    objects_in_view: float
    objects_km3: float
    detected: Array


def chance_of(samples: Samples, farthest_km: float, detected: float) -> Chance:
    """Return the first estimate, with one probability of detection for all sensors."""
    n_sensors = len(samples.field_sr)
    count = np.bincount(samples.sensor, minlength=n_sensors).astype(float)
    instants = np.maximum(samples.seen.any(axis=0).sum(), 1)
    # A tracklet counts by its share of the instants: it is in the field at these only.
    share = np.bincount(samples.sensor, samples.seen.sum(axis=1), minlength=n_sensors) / instants
    density = np.maximum(share, 1.0) / samples.field_sr
    rate = _rates(samples)
    drift, spread = np.zeros((n_sensors, 3)), np.empty(n_sensors)
    moving = np.flatnonzero(np.isfinite(rate[:, 0]))
    moving = moving[np.argsort(samples.sensor[moving], kind="stable")]
    first = np.searchsorted(samples.sensor[moving], np.arange(n_sensors + 1))
    for s in range(n_sensors):
        rates = rate[moving[first[s] : first[s + 1]]]
        if len(rates):
            # The rate of a single tracklet tells nothing of what is usual: it is its own.
            drift[s] = np.median(rates, axis=0) * (1 - 1 / len(rates))
        spread[s] = _spread(rates - drift[s])
    volume = float(np.median(samples.field_sr)) * farthest_km**3 / 3
    objects = max(float(np.median(count)), 1.0)
    return Chance(density, drift, spread, objects, objects / volume, np.full(n_sensors, detected))


def _spread(deviation: Array) -> float:
    """Return the spread of a sensor's rates [rad/s, 1-sigma per axis], from their deviations.

    The median takes one rate away: a sensor with one tracklet says nothing of its spread. The
    logarithm is the mean of the sensor's and `USUAL_SPREAD`'s, which counts as one tracklet.
    """
    others = max(len(deviation) - 1, 0)
    square = (np.sum(deviation**2) / 2 + MIN_SPREAD**2) / (others + 2)
    log_spread = (others * np.log(square) / 2 + np.log(USUAL_SPREAD)) / (others + 1)
    return float(np.exp(log_spread))


def _rates(samples: Samples) -> Array:
    """Return each tracklet's mean rate [rad/s] from first to last sample; NaN with one sample."""
    out = np.full((len(samples.sensor), 3), np.nan)
    n_instants = samples.seen.shape[1]
    twice = np.flatnonzero(samples.seen.sum(axis=1) > 1)
    if len(twice):
        a = np.argmax(samples.seen[twice], axis=1)
        b = n_instants - 1 - np.argmax(samples.seen[twice, ::-1], axis=1)
        dt = samples.time_s[b] - samples.time_s[a]
        out[twice] = (samples.u[twice, b] - samples.u[twice, a]) / dt[:, None]
    return out


# Probability of detection


class Looks(NamedTuple):
    """Detections and misses: a row for each object and each sensor that has it in its field.

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

    A sensor is judged by those groups that enough other sensors detect. They are found whether
    this sensor detects them or not, so objects too faint to be found do not bias the estimate.
    The share of detections is shrunk towards the mean of all sensors, which itself is shrunk
    towards `prior`.
    """
    n_sensors = len(views.half_field)
    row, sensor, hit = looks_of(views, groups)
    others = np.bincount(row[hit], minlength=len(groups))[row] - hit
    asked = others >= (OTHERS if len(views.time_s) > 1 else OTHERS_AT_ONCE)
    looked = np.bincount(sensor[asked], minlength=n_sensors)
    hits = np.bincount(sensor[asked & hit], minlength=n_sensors)
    common = (hits.sum() + PRIOR_LOOKS * prior) / (looked.sum() + PRIOR_LOOKS)
    return np.clip(
        (hits + PRIOR_LOOKS * common) / (looked + PRIOR_LOOKS), MIN_DETECTION, MAX_DETECTION
    )


# Number of objects


def visible_volume(views: Views, shells: Array, farthest_km: float) -> Array:
    """Return the volume [km^3] that at least two sensors see in each shell, times its weight, (j,).

    `shells` are rows of (lowest, highest radius [km], weight). The volume is integrated along
    sample lines of sight, at the instant at which most sensors have a known attitude. Zero if
    fewer than two sensors have one.
    """
    ready = np.isfinite(views.position_km[..., 0]) & np.isfinite(views.attitude[..., 0, 0])
    m = int(np.argmax(ready.sum(axis=0)))
    known = np.flatnonzero(ready[:, m])
    out = np.zeros(len(shells))
    if len(known) < 2:
        return out
    side = max(int(np.sqrt(SIGHTS / len(known))), 1)
    camera = np.ascontiguousarray(views.camera[known, m])
    of = max(len(known) / SIGHTS, 1.0)  # each sampled sensor stands for this many
    known = known[(np.arange(int(len(known) / of)) * of).astype(int)]
    middle = (np.arange(side) + 0.5) / side * 2 - 1
    for s in known.tolist():
        a, b = np.meshgrid(*(middle * half for half in views.half_field[s]), indexing="ij")
        stretch = np.sqrt(1 + a * a + b * b).ravel()
        toward = np.stack([a.ravel(), b.ravel(), np.ones(a.size)], axis=1) / stretch[:, None]
        u = toward @ views.attitude[s, m]
        cell_sr = np.prod(views.half_field[s]) * 4 / side**2 / stretch**3
        rho, edges = _steps(views.position_km[s, m], u, shells, farthest_km)
        x = views.position_km[s, m] + rho[..., None] * u[:, None]
        count = _in_view_of(camera, x.reshape(-1, 3)).reshape(rho.shape)
        volume = np.diff(edges**3, axis=1) / 3 * cell_sr[:, None]
        volume = np.where(count >= 2, volume / np.maximum(count, 1), 0.0)
        radius = np.linalg.norm(x, axis=2)
        for j, (lowest, highest, weight) in enumerate(shells):
            inside = (radius >= lowest) & (radius < highest)
            out[j] += of * weight * volume[inside].sum()
    return out


@kernel
def _in_view_of(camera, x):
    """Return how many sensors, rows of `camera` (s, 33), see each point x (n, 3) [km], (n,)."""
    count = np.zeros(len(x), np.int64)
    for i in range(len(x)):
        for s in range(len(camera)):
            count[i] += in_view(camera[s], x[i])
    return count


def _steps(r_km: Array, u: Array, shells: Array, farthest_km: float) -> tuple[Array, Array]:
    """Return middles and edges [km] of steps along lines of sight, split at the shells' edges."""
    along, r2 = u @ r_km, r_km @ r_km
    edges = [np.tile(np.linspace(0, farthest_km, STEPS), (len(u), 1))]
    for radius in np.unique(shells[:, :2]):
        if 0 < radius < np.inf:
            square = along**2 - r2 + radius**2
            root = np.sqrt(np.maximum(square, 0))
            edges += [np.maximum(-along - root, 0)[:, None], np.maximum(-along + root, 0)[:, None]]
    edge = np.sort(np.clip(np.concatenate(edges, axis=1), 0, farthest_km), axis=1)
    return (edge[:, 1:] + edge[:, :-1]) / 2, edge


def revised_odds(
    scores: Array, radius_km: Array, shells: Array, volume_km3: Array, chance: Chance
) -> Array:
    """Return the groups' log-odds once the number of objects is known.

    Parameters
    ----------
    scores, radius_km : (g,) float
        Log-odds of the search, and the groups' distances from the Earth's centre.
    shells : (j, 3) float
        Lowest, highest radius, weight.
    volume_km3 : (j,) float
        Volumes in view, see `visible_volume`.
    chance
        With the object density that the search assumed.

    Notes
    -----
    The iteration starts from the certain groups and adds others, so it ends at the smallest
    numbers of objects that are consistent.
    """
    inside = (radius_km[:, None] >= shells[:, 0]) & (radius_km[:, None] < shells[:, 1])
    believed = inside * shells[:, 2] + 1e-9
    if not volume_km3.any():  # unknown: as if two sensors saw all of it
        volume_km3 = np.full(len(shells), chance.objects_in_view / chance.objects_km3)
    expected = chance.objects_km3 * volume_km3 + 1e-9
    sure = (scores > CERTAIN_LOG_ODDS).astype(float)
    revised = scores
    for _ in range(ROUNDS):
        factor = _shell_rates(sure, believed, expected)
        revised = scores + np.log((believed * factor).sum(axis=1) / believed.sum(axis=1))
        last, sure = sure, 1 / (1 + np.exp(-np.clip(revised, -50, 50)))
        if np.abs(sure - last).max() < 1e-6:
            break
    return revised


def _shell_rates(sure: Array, believed: Array, expected: Array) -> Array:
    """Return the rate of objects in each shell over the assumed rate."""
    common = max(sure.sum(), 0.5) / expected.sum()
    factor = np.full(len(expected), common)
    for _ in range(10):  # an object may belong to either of two shells that overlap
        belongs = believed * factor
        count = (sure[:, None] * belongs / belongs.sum(axis=1, keepdims=True)).sum(axis=0)
        ratio = (count + PRIOR_OBJECTS) / (common * expected + PRIOR_OBJECTS)
        factor = common * np.minimum(ratio, MAX_RATE_RATIO)
    return factor

"""How unrelated tracklets behave and how many objects there are, estimated from the data.

The odds of a hypothesis need three estimates, in the order in which a search makes them:

1. `chance_of`, before anything is associated: density and motion of each sensor's tracklets.
2. `estimated_detection`, from certain groups: each sensor's probability of detection.
3. `revised_odds`, from all groups: the number of objects near each group, in each altitude shell,
   and with it the groups' final log-odds.

The third one is empirical Bayes. The search assumes that every tracklet may be an object, and the
altitude prior as stated. The certain groups show how many objects the volume really holds and at
which altitudes. Counts are Poisson. The rate of all shells together has a gamma prior about the
rate that the search assumed, and the rate of a shell one about the rate common to all shells.
"""

from collections.abc import Sequence
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.association.hypothesis_queue import Hypothesis
from epipole.tasks.algorithms.association.odds import in_view
from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.association.views import Views
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.kernels import kernel

CERTAIN_LOG_ODDS = 8.0  # log-odds from which a group is certain
# Minimum number of other sensors that detect an object: with several instants, with a single one.
MIN_OTHERS, MIN_OTHERS_AT_ONCE = 3, 4
PRIOR_LOOKS = 10.0  # weight of the prior, as a number of detections and misses
# Bounds of a sensor's estimated probability: the odds of a hit or a miss stay finite. The lower one
# was reached in no scene tried.
MIN_DETECTION, MAX_DETECTION = 0.05, 0.99
SIGHTS = 200  # lines of sight that sample the fields of a set of sensors
SAMPLED = 12  # sensors of a set whose fields are sampled
STEPS = 24  # along a line of sight, in addition to the shells' edges
# Least share of common sensors, of those in either (Jaccard index), of sets that count as one.
SAME_SENSORS = 0.8
PRIOR_OBJECTS = 1.0  # weight of a prior on the number of objects, as a number of objects
ROUNDS = 100  # maximum number of iterations of `revised_odds`; 50 were enough in all scenes tried
# 1-sigma per axis of the rates of unrelated objects, seen from a low orbit [rad/s]: 900 arcsec/s.
# It counts as one tracklet. The medians of two simulated constellations were 1,600 and 2,900
# arcsec/s.
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
        Assumed number of objects in a field: the median number of tracklets of a sensor that has
        any; and the same per km^3 of a field.
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
    shown = samples.seen.sum(axis=1) / instants
    share = np.bincount(samples.sensor, shown, minlength=n_sensors)
    density = np.maximum(share, 1.0) / samples.field_sr
    rate = _rates(samples)
    drift, spread = np.zeros((n_sensors, 3)), np.empty(n_sensors)
    moving = np.flatnonzero(np.isfinite(rate[:, 0]))
    moving = moving[np.argsort(samples.sensor[moving], kind="stable")]
    first = np.searchsorted(samples.sensor[moving], np.arange(n_sensors + 1))
    for s in range(n_sensors):
        mine = moving[first[s] : first[s + 1]]
        rates, weight = rate[mine], shown[mine]
        if len(rates):
            # The median of a single rate is that rate, not the usual one.
            drift[s] = np.median(rates, axis=0) * (1 - 1 / max(weight.sum(), 1.0))
        spread[s] = _spread(rates - drift[s], weight)
    # Sensors without any tracklet do not count: rows do not depend on who looks elsewhere.
    seeing = count > 0 if count.any() else np.ones(n_sensors, bool)
    volume = float(np.median(samples.field_sr[seeing])) * farthest_km**3 / 3
    objects = max(float(np.median(count[seeing])), 1.0)
    return Chance(density, drift, spread, objects, objects / volume, np.full(n_sensors, detected))


def _spread(deviation: Array, weight: Array) -> float:
    """Return the spread of a sensor's rates [rad/s, 1-sigma per axis], from their deviations.

    Each counts by its share of the instants: the fragments of a track are one tracklet together.
    The logarithm of the spread is the weighted mean of that of the sensor's rates, whose median
    costs one degree of freedom, and that of `USUAL_SPREAD`, which weighs as one tracklet.
    """
    others = max(float(weight.sum()) - 1, 0.0)
    square = (np.sum(weight[:, None] * deviation**2) / 2 + MIN_SPREAD**2) / (others + 2)
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

    A sensor is judged by those groups that enough other sensors detect. These groups are found
    even if this sensor misses them. So objects too faint to be found do not bias the estimate.
    The share of detections is shrunk towards the mean of all sensors, which itself is shrunk
    towards `prior`.
    """
    n_sensors = len(views.half_field)
    row, sensor, hit = looks_of(views, groups)
    others = np.bincount(row[hit], minlength=len(groups))[row] - hit
    judging = others >= (MIN_OTHERS if len(views.time_s) > 1 else MIN_OTHERS_AT_ONCE)
    looked = np.bincount(sensor[judging], minlength=n_sensors)
    hits = np.bincount(sensor[judging & hit], minlength=n_sensors)
    common = (hits.sum() + PRIOR_LOOKS * prior) / (looked.sum() + PRIOR_LOOKS)
    return np.clip(
        (hits + PRIOR_LOOKS * common) / (looked + PRIOR_LOOKS), MIN_DETECTION, MAX_DETECTION
    )


# Number of objects


class VisibleVolumes(NamedTuple):
    """Volumes [km^3] that sets of sensors see in each shell, times its weight, (p, j) each.

    NaN if fewer than two of a set's sensors have a known attitude.

    shared
        What two or more of the sensors see.
    exclusive
        The part of it that only this set of sensors sees, or a similar one (`SAME_SENSORS`).
    """

    shared: Array
    exclusive: Array


def visible_volumes(
    views: Views, sets: Sequence[Indices], shells: Array, farthest_km: float
) -> VisibleVolumes:
    """Return the volumes that sets of sensors see."""
    volume = [_visible_volume(views, sensors, shells, farthest_km) for sensors in sets]
    shared, exclusive = np.reshape(volume, (-1, 2, len(shells))).swapaxes(0, 1)
    return VisibleVolumes(shared, exclusive)


def _visible_volume(views: Views, sensors: Indices, shells: Array, farthest_km: float) -> Array:
    """Return the two volumes of one set, (2, j).

    They are integrated along lines of sight of up to `SAMPLED` of the sensors, at the instant at
    which most sensors have a known attitude.
    """
    ready = np.isfinite(views.position_km[..., 0]) & np.isfinite(views.attitude[..., 0, 0])
    m = int(np.argmax(ready[sensors].sum(axis=0)))
    known = sensors[ready[sensors, m]]
    if len(known) < 2:
        return np.full((2, len(shells)), np.nan)
    others = np.setdiff1d(np.flatnonzero(ready[:, m]), known)
    camera = np.ascontiguousarray(views.camera[known, m])
    sampled = known[np.arange(min(len(known), SAMPLED)) * len(known) // min(len(known), SAMPLED)]
    side = int(np.sqrt(SIGHTS / len(sampled)))
    volume = np.zeros((2, len(shells)))
    for s in sampled.tolist():
        r_km, R = views.position_km[s, m], views.attitude[s, m]
        u, cell_sr = _sights(views.half_field[s], R, side)
        overlap = _overlap(views, known[known != s], m, r_km, u, farthest_km)
        rho, edges = _steps(r_km, u, shells, *overlap)
        x = r_km + rho[..., None] * u[:, None]
        near = others[_may_see(views, others, m, x[overlap[0] < overlap[1]])]
        theirs_too = np.ascontiguousarray(views.camera[near, m])
        count, theirs = _seen_by(camera, theirs_too, x.reshape(-1, 3)).T.reshape(2, *rho.shape)
        # A point is met from each sensor that sees it.
        part = (
            np.diff(edges**3, axis=1) / 3 * cell_sr[:, None] / np.maximum(count, 1) * (count >= 2)
        )
        parts = np.stack([part, part * theirs])
        radius = np.linalg.norm(x, axis=2)
        for j, (inner, outer) in enumerate(shells[:, :2]):
            volume[:, j] += parts[:, (radius >= inner) & (radius < outer)].sum(axis=1)
    return len(known) / len(sampled) * shells[:, 2] * volume


def _sights(half_field: Array, R_sensor_from_icrs: Array, side: int) -> tuple[Array, Array]:
    """Return lines of sight that sample a field evenly, (n, 3), and their solid angles [sr]."""
    middle = (np.arange(side) + 0.5) / side * 2 - 1
    a, b = np.meshgrid(*(middle * half for half in half_field), indexing="ij")
    stretch = np.sqrt(1 + a * a + b * b).ravel()
    toward = np.stack([a.ravel(), b.ravel(), np.ones(a.size)], axis=1) / stretch[:, None]
    return toward @ R_sensor_from_icrs, np.prod(half_field) * 4 / side**2 / stretch**3


def _overlap(
    views: Views, sensors: Indices, m: int, r_km: Array, u: Array, farthest_km: float
) -> tuple[Array, Array]:
    """Return the ranges [km] between which lines of sight from r_km lie in any field, (n,) each.

    A field is convex: it is bounded by four planes and that of the sensor. So a line has one piece
    in it. Without such a piece both ranges are 0.
    """
    R, half = views.attitude[sensors, m], views.half_field[sensors, :, None]
    sides = [half[:, k] * R[:, 2] + sign * R[:, k] for k in (0, 1) for sign in (-1, 1)]
    normal = np.stack([R[:, 2], *sides], axis=1)
    start = np.einsum("ski,si->sk", normal, r_km - views.position_km[sensors, m])
    slope = np.einsum("ni,ski->nsk", u, normal)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = -start / slope
    low = np.where(slope > 0, at, np.where((slope == 0) & (start < 0), np.inf, 0.0)).max(axis=2)
    high = np.where(slope < 0, at, farthest_km).min(axis=2)
    low, high = np.clip(low, 0, farthest_km), np.clip(high, 0, farthest_km)
    crosses = low < high
    lowest = np.where(crosses, low, farthest_km).min(axis=1)
    highest = np.where(crosses, high, 0.0).max(axis=1)
    return np.minimum(lowest, highest), highest


def _may_see(views: Views, sensors: Indices, m: int, x_km: Array) -> Flags:
    """Return which sensors' fields may have any of the points x_km in them, (s,).

    Of thousands of sensors, nearly all look past the few that share a field. Each field's cone is
    compared with the sphere around the points. Without points all are false.
    """
    if not x_km.size:
        return np.zeros(len(sensors), np.bool_)
    low, high = x_km.min(axis=(0, 1)), x_km.max(axis=(0, 1))
    toward = (low + high) / 2 - views.position_km[sensors, m]
    distance = np.linalg.norm(toward, axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        off_axis = np.arccos(
            np.clip(np.sum(toward * views.attitude[sensors, m, 2], axis=1) / distance, -1, 1)
        )
        radius = np.arcsin(np.linalg.norm(high - low) / 2 / distance)  # NaN: within the sphere
    corner = np.arctan(np.linalg.norm(views.half_field[sensors], axis=1))
    return np.asarray(~(off_axis > corner + radius))


@kernel
def _seen_by(camera, others, x):
    """Return how many sensors of a set see each point x (n, 3) [km], and whether it is theirs.

    Sensors are rows of `camera` (s, 34), and of `others` those that are not of the set. A point is
    theirs (1, else 0) if the set and all sensors that see it are similar, see `SAME_SENSORS`.
    Result: (n, 2).
    """
    seen_by = np.zeros((len(x), 2))
    for i in range(len(x)):
        inside = 0
        for s in range(len(camera)):
            inside += in_view(camera[s], x[i])
        seen_by[i, 0] = inside
        if inside < 2:
            continue
        limit, either = inside / SAME_SENSORS, len(camera)
        for s in range(len(others)):
            if either > limit:
                break
            either += in_view(others[s], x[i])
        seen_by[i, 1] = either <= limit
    return seen_by


def _steps(
    r_km: Array, u: Array, shells: Array, lowest_km: Array, highest_km: Array
) -> tuple[Array, Array]:
    """Return middles and edges [km] of steps along lines of sight, split at the shells' edges."""
    lowest, highest = lowest_km[:, None], highest_km[:, None]
    along, r2 = u @ r_km, r_km @ r_km
    edges = [lowest + (highest - lowest) * np.linspace(0, 1, STEPS)]
    for radius in np.unique(shells[:, :2]):
        if 0 < radius < np.inf:
            square = along**2 - r2 + radius**2
            root = np.sqrt(np.maximum(square, 0))
            edges += [(-along - root)[:, None], (-along + root)[:, None]]
    edge = np.sort(np.clip(np.concatenate(edges, axis=1), lowest, highest), axis=1)
    return (edge[:, 1:] + edge[:, :-1]) / 2, edge


class SensorSets(NamedTuple):
    """Sets of sensors that have groups in their fields.

    sensors : list of (n,) int
        The sensors of each set.
    set_of : (g,) int
        The set that has each group in its fields.
    row, group : (n,) int
        The groups that at least two sensors of a set (`row`) have in their fields.
    """

    sensors: list[Indices]
    set_of: Indices
    row: Indices
    group: Indices


def sets_of_sensors(views: Views, groups: Sequence[Hypothesis]) -> SensorSets:
    """Return the sets of sensors that have the groups in their fields, the most common one first.

    Sets that are similar to an earlier one are merged into it.
    """
    looks = looks_of(views, groups)
    seen = np.zeros((len(groups), len(views.half_field)), np.bool_)
    seen[looks.row, looks.sensor] = True
    # Packed, they are sorted in the same order and eight times as fast.
    packed, of, count = np.unique(
        np.packbits(seen, axis=1), axis=0, return_inverse=True, return_counts=True
    )
    rows = np.unpackbits(packed, axis=1, count=seen.shape[1]).astype(np.bool_)
    kept, same_as = _distinct_sets(rows, np.argsort(-count, kind="stable"))
    common = coo_array(csr_array(rows[kept].astype(np.int32)) @ csr_array(seen.T.astype(np.int32)))
    several = common.data > 1
    row, group = (np.asarray(of_axis[several], np.int64) for of_axis in common.coords)
    order = np.lexsort((group, row))
    sets = [np.flatnonzero(r) for r in rows[kept]]
    return SensorSets(sets, same_as[of.ravel()], row[order], group[order])


def _distinct_sets(rows: Flags, order: Indices) -> tuple[list[int], Indices]:
    """Return which sets of sensors, (r, s) bool, are kept, and for each set the kept one that it is
    merged into.

    Sets are compared with those that share a sensor with them: thousands of sensors, few of which
    look at one volume, have nearly as many sets as groups.
    """
    size, size_of_kept = rows.sum(axis=1), np.zeros(len(rows), np.int64)
    kept: list[int] = []
    kept_of_sensor: list[list[int]] = [[] for _ in range(rows.shape[1])]
    same_as = np.empty(len(rows), np.int64)
    for k in order.tolist():
        sensors = np.flatnonzero(rows[k]).tolist()
        near = np.array(list(chain.from_iterable(kept_of_sensor[s] for s in sensors)), np.int64)
        near, shared = np.unique(near, return_counts=True)
        likeness = shared / (size[k] + size_of_kept[near] - shared)
        if likeness.max(initial=0.0) >= SAME_SENSORS:
            same_as[k] = near[np.argmax(likeness)]
            continue
        same_as[k], size_of_kept[len(kept)] = len(kept), size[k]
        for s in sensors:
            kept_of_sensor[s].append(len(kept))
        kept.append(k)
    return kept, same_as


def revised_odds(
    scores: Array,
    radius_km: Array,
    shells: Array,
    sets: SensorSets,
    volumes: VisibleVolumes,
    chance: Chance,
) -> Array:
    """Return the groups' log-odds once the number of objects near them is known.

    Objects that other sensors see elsewhere are no evidence on the number of objects here. So it is
    estimated for each set of sensors: first from all groups that at least two of these have in
    their fields, then from those of exactly this set. Most chance groups are alone in their set.

    Parameters
    ----------
    scores, radius_km : (g,) float
        Log-odds of the search, and the groups' distances from the Earth's centre.
    shells : (j, 3) float
        Lowest, highest radius, weight.
    sets
        Of the groups, see `sets_of_sensors`.
    volumes
        Volumes that the sets see.
    chance
        With the object density that the search assumed.

    Notes
    -----
    The iteration starts from the certain groups and adds others, so it ends at the smallest
    numbers of objects that are consistent.
    """
    inside = (radius_km[:, None] >= shells[:, 0]) & (radius_km[:, None] < shells[:, 1])
    prior_weight = inside * shells[:, 2] + 1e-9
    # An unknown volume counts as one that two sensors see in full.
    unknown = chance.objects_in_view / len(shells)
    expected = VisibleVolumes(
        *(np.where(np.isnan(v), unknown, chance.objects_km3 * v)[sets.set_of] for v in volumes)
    )
    certainty = (scores > CERTAIN_LOG_ODDS).astype(float)
    revised = scores
    for _ in range(ROUNDS):
        factor = _shell_rates(certainty, prior_weight, sets, expected)
        revised = scores + np.log((prior_weight * factor).sum(axis=1) / prior_weight.sum(axis=1))
        last, certainty = certainty, 1 / (1 + np.exp(-np.clip(revised, -50, 50)))
        if np.abs(certainty - last).max() < 1e-6:
            break
    return revised


def _shell_rates(
    certainty: Array, prior_weight: Array, sets: SensorSets, expected: VisibleVolumes
) -> Array:
    """Return the rate of objects over the assumed rate in each shell, near each group, (g, j).

    `expected` are numbers of objects at the assumed rate. A group does not count for itself.
    """
    n_sets, set_of, here = len(sets.sensors), sets.set_of, expected.exclusive
    near = np.bincount(sets.row, certainty[sets.group], minlength=n_sets)[set_of]
    others = near - certainty + PRIOR_OBJECTS
    common = others / (expected.shared.sum(axis=1) + PRIOR_OBJECTS)
    others = np.bincount(set_of, certainty)[set_of] - certainty + PRIOR_OBJECTS
    common = (common * others / (common * here.sum(axis=1) + PRIOR_OBJECTS))[:, None]
    factor = np.repeat(common, here.shape[1], axis=1)
    for _ in range(10):  # an object may belong to either of two shells that overlap
        belongs = prior_weight * factor
        share = certainty[:, None] * belongs / belongs.sum(axis=1, keepdims=True)
        count = np.zeros((n_sets, here.shape[1]))
        np.add.at(count, set_of, share)
        others = count[set_of] - share + PRIOR_OBJECTS
        factor = common * (others / (common * here + PRIOR_OBJECTS))
    return factor

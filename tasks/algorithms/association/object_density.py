"""Object density: how many objects there are, shell by shell, as the groups found tell.

The search takes every tracklet for a possible object and the altitude prior at its word. The
sure groups tell how many objects the space in view really holds and at what heights; by as much
the odds of all groups change. Empirical Bayes: the rate of each shell is Poisson with a gamma
prior about the common one.
"""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.samples import Chance, Views
from epipole.tasks.algorithms.association.visibility import EARTH_RADIUS_KM

Array = npt.NDArray[np.float64]

SIGHTS = 5  # a side: lines of sight that sample a field
STEPS = 40  # along a line of sight, beside the shells' edges
ORIGINS = 8  # sensors whose fields are sampled
PRIOR_OBJECTS = 1.0  # as good as so many objects does a shell's own share count
CERTAIN_LOG_ODDS = 8.0  # groups that count from the start
ROUNDS = 100


def visible_volume(views: Views, shells: Array, farthest_km: float) -> Array:
    """Return the volume [km^3] that two sensors see, weighed by each of the shells, (j,).

    `shells` are rows of (lowest, highest radius [km], weight). At the middle instant, by lines
    of sight of up to eight sensors.
    """
    n = len(views.half_field)
    m = views.seen.shape[1] // 2
    known = np.flatnonzero(
        np.isfinite(views.r_km[:, m, 0]) & np.isfinite(views.attitude[:, m, 0, 0])
    )
    chosen = known[np.unique(np.linspace(0, len(known) - 1, ORIGINS).astype(int))] if n else known
    out = np.zeros(len(shells))
    if len(known) < 2:
        return out
    middle = (np.arange(SIGHTS) + 0.5) / SIGHTS * 2 - 1
    for s in chosen.tolist():
        a, b = np.meshgrid(*(middle * side for side in views.half_field[s]), indexing="ij")
        stretch = np.sqrt(1 + a * a + b * b).ravel()
        toward = np.stack([a.ravel(), b.ravel(), np.ones(a.size)], axis=1) / stretch[:, None]
        u = toward @ views.attitude[s, m]
        cell_sr = np.prod(views.half_field[s]) * 4 / SIGHTS**2 / stretch**3
        rho, edges = _steps(views.r_km[s, m], u, shells, farthest_km)
        x = views.r_km[s, m] + rho[..., None] * u[:, None]
        count = np.zeros(rho.shape)
        for other in known.tolist():
            count += _in_field(views, other, m, x)
        volume = np.diff(edges**3, axis=1) / 3 * cell_sr[:, None]
        volume = np.where(count >= 2, volume / np.maximum(count, 1), 0.0)
        radius = np.linalg.norm(x, axis=2)
        for j, (lowest, highest, weight) in enumerate(shells):
            inside = (radius >= lowest) & (radius < highest)
            out[j] += weight * volume[inside].sum() * len(known) / len(chosen)
    return out


def _steps(r_km: Array, u: Array, shells: Array, farthest_km: float) -> tuple[Array, Array]:
    """Return middles and edges of the steps along lines of sight, split at the shells' edges."""
    along, r2 = u @ r_km, r_km @ r_km
    edges = [np.tile(np.linspace(0, farthest_km, STEPS), (len(u), 1))]
    for radius in np.unique(shells[:, :2]):
        if 0 < radius < np.inf:
            square = along**2 - r2 + radius**2
            root = np.sqrt(np.maximum(square, 0))
            edges += [np.maximum(-along - root, 0)[:, None], np.maximum(-along + root, 0)[:, None]]
    edge = np.sort(np.clip(np.concatenate(edges, axis=1), 0, farthest_km), axis=1)
    return (edge[:, 1:] + edge[:, :-1]) / 2, edge


def _in_field(views: Views, s: int, m: int, x: Array) -> Array:
    """Return 1 where sensor s sees points (..., 3), else 0."""
    d = (x - views.r_km[s, m]) @ views.attitude[s, m].T
    inside = (np.abs(d[..., :2]) < views.half_field[s] * d[..., 2:]).all(axis=-1)
    sight = x - views.r_km[s, m]
    along = sight @ views.r_km[s, m]
    length2 = np.maximum((sight**2).sum(axis=-1), 1e-9)
    closest2 = views.r_km[s, m] @ views.r_km[s, m] - along**2 / length2
    hidden = (along < 0) & (-along < length2) & (closest2 < EARTH_RADIUS_KM**2)
    return (inside & ~hidden).astype(float)


def revised_odds(
    scores: Array, radius_km: Array, shells: Array, volume_km3: Array, chance: Chance
) -> Array:
    """Return the groups' log-odds once the number of objects is known.

    Parameters
    ----------
    scores, radius_km : (g,) float
        Log-odds as searched with, and the groups' distances from the Earth's centre.
    shells : (j, 3) float
        Lowest, highest radius, weight.
    volume_km3 : (j,) float
        What is in view of each, see `visible_volume`.
    chance
        With the density that the search believed in.

    Notes
    -----
    Upwards from the certain groups, to the smallest numbers that explain themselves.
    """
    inside = (radius_km[:, None] >= shells[:, 0]) & (radius_km[:, None] < shells[:, 1])
    believed = inside * shells[:, 2] + 1e-9
    expected = chance.objects_km3 * volume_km3 + 1e-9
    sure = (scores > CERTAIN_LOG_ODDS).astype(float)
    revised = scores
    for _ in range(ROUNDS):
        factor = _rates(sure, believed, expected)
        revised = scores + np.log((believed * factor).sum(axis=1) / believed.sum(axis=1))
        last, sure = sure, 1 / (1 + np.exp(-np.clip(revised, -50, 50)))
        if np.abs(sure - last).max() < 1e-6:
            break
    return revised


def _rates(sure: Array, believed: Array, expected: Array) -> Array:
    """Return the rate of objects in each shell, over the believed one."""
    common = max(sure.sum(), 0.5) / expected.sum()
    factor = np.full(len(expected), common)
    for _ in range(10):  # where shells overlap, an object may be of either
        belongs = believed * factor
        count = (sure[:, None] * belongs / belongs.sum(axis=1, keepdims=True)).sum(axis=0)
        own = (count + PRIOR_OBJECTS) / (common * expected + PRIOR_OBJECTS)
        factor = common * own
    return factor

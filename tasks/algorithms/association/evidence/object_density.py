"""Object density: how many objects there are in each altitude shell, from the sure groups.

The search assumes that every tracklet may be an object, and the altitude prior as given. The
sure groups tell how many objects the space in view really holds and at which altitudes, and the
odds of all groups change accordingly. Empirical Bayes: the count of each shell is Poisson, its
rate has a gamma prior about the common rate.
"""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.evidence.chance import Chance
from epipole.tasks.algorithms.association.evidence.detection import CERTAIN_LOG_ODDS
from epipole.tasks.algorithms.association.evidence.visibility import in_view
from epipole.tasks.algorithms.association.sampling.views import Views
from epipole.tasks.algorithms.kernels import kernel

Array = npt.NDArray[np.float64]

SIGHTS = 100  # lines of sight that sample all fields together; with more sensors, of so many
STEPS = 24  # along a line of sight, in addition to the shells' edges
MOST = 10.0  # largest rate of a shell over the common rate
PRIOR_OBJECTS = 1.0  # weight of the prior of a shell, as a number of objects
ROUNDS = 100


def visible_volume(views: Views, shells: Array, farthest_km: float) -> Array:
    """Return the volume [km^3] that two sensors see in each shell, times its weight, (j,).

    `shells` are rows of (lowest, highest radius [km], weight). The volume is integrated along
    sample lines of sight, at the instant of most known attitudes; zero for fewer than two.
    """
    ready = np.isfinite(views.place_km[..., 0]) & np.isfinite(views.attitude[..., 0, 0])
    m = int(np.argmax(ready.sum(axis=0)))
    known = np.flatnonzero(ready[:, m])
    out = np.zeros(len(shells))
    if len(known) < 2:
        return out
    side = max(int(np.sqrt(SIGHTS / len(known))), 1)
    camera = np.ascontiguousarray(views.camera[known, m])
    of = max(len(known) / SIGHTS, 1.0)  # sensors that each sampled one stands for
    known = known[(np.arange(int(len(known) / of)) * of).astype(int)]
    middle = (np.arange(side) + 0.5) / side * 2 - 1
    for s in known.tolist():
        a, b = np.meshgrid(*(middle * half for half in views.half_field[s]), indexing="ij")
        stretch = np.sqrt(1 + a * a + b * b).ravel()
        toward = np.stack([a.ravel(), b.ravel(), np.ones(a.size)], axis=1) / stretch[:, None]
        u = toward @ views.attitude[s, m]
        cell_sr = np.prod(views.half_field[s]) * 4 / side**2 / stretch**3
        rho, edges = _steps(views.place_km[s, m], u, shells, farthest_km)
        x = views.place_km[s, m] + rho[..., None] * u[:, None]
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
    """Return how many sensors see each point, (n,)."""
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
    An iteration upwards from the certain groups, to the smallest consistent numbers.
    """
    inside = (radius_km[:, None] >= shells[:, 0]) & (radius_km[:, None] < shells[:, 1])
    believed = inside * shells[:, 2] + 1e-9
    if not volume_km3.any():  # unknown: as if two sensors saw all of it
        volume_km3 = np.full(len(shells), chance.objects_in_view / chance.objects_km3)
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
    """Return the rate of objects in each shell over the assumed rate."""
    common = max(sure.sum(), 0.5) / expected.sum()
    factor = np.full(len(expected), common)
    for _ in range(10):  # an object may belong to either of two shells that overlap
        belongs = believed * factor
        count = (sure[:, None] * belongs / belongs.sum(axis=1, keepdims=True)).sum(axis=0)
        ratio = (count + PRIOR_OBJECTS) / (common * expected + PRIOR_OBJECTS)
        factor = common * np.minimum(ratio, MOST)
    return factor

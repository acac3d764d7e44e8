"""The odds that a fixed place of the image is a hot pixel, and not light that the sensor follows.

Light scatters by the centroid error, and drifts as far as the sensor follows it badly. It falls
anywhere on a pixel, and near the middle of the field. A hot pixel scatters by an error of its own,
mostly a small one. It does not drift, it stands on the middle of a pixel, and it may be anywhere
in the field.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.special import logsumexp

from epipole.tasks.algorithms.geometry.camera import Camera

Array = npt.NDArray[np.float64]

SCALES = np.geomspace(0.01, 3.0, 200)  # of a place's scatter, over what its sigmas say
TOLD_WITHIN = np.log(1.5)  # 1-sigma of ln of that scale for light: sigmas are told so well
STEADIEST, UNSTEADIEST = 0.01, 2.0  # the same scale of a hot pixel: any between, alike in ln
OFF_MIDDLE = 0.1  # share of hot pixels that are not on a middle: two neighbours, for example
MIDDLE_PX = 0.02  # 1-sigma of the others: neighbours are a little warm
HELD_STILL = 0.5  # share of followed objects that do not drift
HELD_ON_MIDDLE = 0.1  # share of followed objects that the sensor holds on the middle of a pixel
AT_CENTRE = 0.5  # share of followed objects that are near the principal point
CENTRE = 0.1  # 1-sigma of their distance from it, in widths of the field
UNKNOWN = 0.5  # places of each kind that are added to those counted: Jeffreys' prior


class FixedPlace(NamedTuple):
    """Detections at one place of the image.

    time_s, x_px, y_px, sigma_px : (n,) float
    reach_px : detections farther than this from the middle of all belong to no place
    """

    time_s: Array
    x_px: Array
    y_px: Array
    sigma_px: Array
    reach_px: float


class _Line(NamedTuple):
    """A straight line through the centroids of a place, about the middle of a pixel.

    off, drift : (2,) float, mean place [px] and its rate [px/s], with variances for a scale of 1
    misfit, freedom : chi-square and its degrees of freedom
    """

    off: Array
    off_variance: float
    drift: Array
    drift_variance: float
    misfit: float
    freedom: int


def log_ratio(place: FixedPlace, camera: Camera, n_places: int) -> float:
    """Return ln of the likelihood of a hot pixel over that of light.

    Parameters
    ----------
    place
        Detections at one place, at least three.
    n_places
        Places of the sensor that may be light: it holds one of them on the middle of a pixel.
    """
    line = _line(place)
    of_scatter = -line.freedom * np.log(SCALES) - 0.5 * line.misfit / SCALES**2
    off_2, drift_2 = float(line.off @ line.off), float(line.drift @ line.drift)
    on_middle = _normal(off_2, line.off_variance * SCALES**2 + MIDDLE_PX**2)
    still = _normal(drift_2, line.drift_variance * SCALES**2)
    farthest = 2 * place.reach_px / max(float(np.ptp(place.time_s)), 1e-9)
    drifting = _normal(drift_2, line.drift_variance * SCALES**2 + farthest**2)
    hot = np.logaddexp(np.log(OFF_MIDDLE), np.log(1 - OFF_MIDDLE) + on_middle) + still
    held = HELD_ON_MIDDLE / n_places
    light = np.logaddexp(np.log(1 - held), np.log(held) + on_middle)
    light += np.logaddexp(np.log(HELD_STILL) + still, np.log(1 - HELD_STILL) + drifting)
    steady = (SCALES >= STEADIEST) & (SCALES <= UNSTEADIEST)
    as_told = -0.5 * (np.log(SCALES) / TOLD_WITHIN) ** 2
    hot = logsumexp((of_scatter + hot)[steady]) - np.log(np.sum(steady))
    light = logsumexp(of_scatter + light + as_told) - logsumexp(as_told)
    return float(hot - light - _nearness(place, camera))


def with_population(ratios: Array) -> Array:
    """Return ln of the odds of places, from their log ratios and what the other places are.

    The more of the other places are hot pixels, the likelier each is one.
    """
    odds = np.zeros(len(ratios))
    for _ in range(100):
        hot = 1 / (1 + np.exp(-np.clip(ratios + odds, -50, 50)))
        others_hot, others_light = hot.sum() - hot, (1 - hot).sum() - (1 - hot)
        odds = np.log((others_hot + UNKNOWN) / (others_light + UNKNOWN))
    return np.asarray(ratios + odds)


def _line(place: FixedPlace) -> _Line:
    weight = place.sigma_px**-2.0
    off = np.stack([place.x_px - np.round(place.x_px.mean()),
                    place.y_px - np.round(place.y_px.mean())], axis=1)  # fmt: skip
    total = weight.sum()
    mean = weight @ off / total
    lever = place.time_s - weight @ place.time_s / total
    spread = max(float(weight @ lever**2), 1e-12)
    drift = (weight * lever) @ (off - mean) / spread
    left = off - mean - lever[:, None] * drift
    misfit = float(weight @ np.sum(left**2, axis=1))
    return _Line(mean, 1 / total, drift, 1 / spread, misfit, 2 * len(weight) - 4)


def _normal(distance_2: float, variance: Array) -> Array:
    """Return ln of the density of a normal distribution on the plane."""
    return np.asarray(-0.5 * distance_2 / variance - np.log(2 * np.pi * variance))


def _nearness(place: FixedPlace, camera: Camera) -> float:
    """Return ln of how much likelier an object is followed here than anywhere in the field."""
    area, variance = camera.width * camera.height, (CENTRE * camera.width) ** 2
    distance_2 = (place.x_px.mean() - camera.cx_px) ** 2 + (place.y_px.mean() - camera.cy_px) ** 2
    near = np.exp(-0.5 * distance_2 / variance) / (2 * np.pi * variance)
    return float(np.log(1 - AT_CENTRE + AT_CENTRE * area * near))

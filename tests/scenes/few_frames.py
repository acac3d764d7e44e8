"""Sequences of few frames with their truth: geostationary objects before a telescope at rest."""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.geometry.directions import tangent_basis

ARCSEC = np.pi / 180 / 3600
PIXEL_RAD = 4.5 * ARCSEC
FIELD_RAD = np.array([640, 480]) * PIXEL_RAD
INTERVAL_S = 40.0
SIDEREAL_RAD_S = 15.04 * ARCSEC


class FewFrames(NamedTuple):
    """Detections of some frames, in the layout of the tracker, and the object of each.

    `object_of` is -1 for stray points.
    """

    time_s: Array
    offsets: Indices
    u_icrs: Array
    sigma_rad: Array
    object_of: Indices


def few_frames(
    seed: int,
    n_objects: int,
    n_false: float,
    *,
    n_frames: int = 5,
    sigma_px: float = 0.4,
    missed: float = 0.0,
) -> FewFrames:
    """Return objects that drift by up to a second of arc per second, among stray points.

    The camera rests on the ground, so the sky moves through its field. Strays are anywhere in the
    field, `n_false` of them in each frame (Poisson).
    """
    rng = np.random.default_rng(seed)
    time_s = np.arange(n_frames) * INTERVAL_S
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    basis = tangent_basis(axis)
    heading = rng.uniform(0, 2 * np.pi)
    sky = SIDEREAL_RAD_S * np.array([np.cos(heading), np.sin(heading)])
    start = rng.uniform(-0.5, 0.5, (n_objects, 2)) * FIELD_RAD
    rate = sky + rng.normal(size=(n_objects, 2)) * 0.3 * ARCSEC
    offsets, places, object_of = [0], [], []
    for t in time_s:
        seen = np.flatnonzero(rng.random(n_objects) >= missed)
        stray = sky * t + rng.uniform(-0.5, 0.5, (rng.poisson(n_false), 2)) * FIELD_RAD
        places.append(np.vstack([start[seen] + rate[seen] * t, stray]))
        object_of.append(np.concatenate([seen, np.full(len(stray), -1)]))
        offsets.append(offsets[-1] + len(places[-1]))
    place = np.concatenate(places)
    place = place + rng.normal(size=place.shape) * sigma_px * PIXEL_RAD
    u = axis + place @ basis
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    sigma = np.full(len(u), sigma_px * PIXEL_RAD)
    return FewFrames(time_s, np.array(offsets), u, sigma, np.concatenate(object_of))


def found_and_false(scene: FewFrames, track: Indices, least: int) -> tuple[int, int, int]:
    """Return how many objects with `least` detections have a track, how many such objects there
    are, and how many tracks are of no object for the most part."""
    found, false = set(), 0
    for k in range(track.max(initial=-1) + 1):
        members = scene.object_of[track == k]
        best = np.bincount(members[members >= 0], minlength=1)
        if 2 * best.max() > len(members):
            found.add(int(best.argmax()))
        else:
            false += 1
    count = np.bincount(scene.object_of[scene.object_of >= 0], minlength=1)
    asked = set(np.flatnonzero(count >= least).tolist())
    return len(found & asked), len(asked), false

"""Co-located geostationary satellites, as a low sensor sees them."""

import numpy as np

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.tracking.runs import SkyDetections, follow_detections

SIGMA = 1.2 * ARCSEC
NEIGHBOURS_KM = 14.0  # 70 arcsec


def ring(seed, every_s=30.0, n_frames=9, spread_km_s=0.005, apart_km=NEIGHBOURS_KM):
    """Return a low sensor's times, offsets, directions, and the object of each direction.

    Six pairs of co-located geostationary satellites in a field of 4 degrees; a tenth is missed.
    """
    rng = np.random.default_rng(seed)
    t = every_s * np.arange(n_frames)
    angle = 7.5 / 7000.0 * t + rng.uniform(-1.0, 1.0)
    tilt = rng.uniform(-1.0, 1.0)
    flat = np.stack([np.cos(angle), np.sin(angle) * np.cos(tilt), np.sin(angle) * np.sin(tilt)], 1)
    sites = np.array([42164.0, 0.0, 0.0]) + rng.uniform(-1200.0, 1200.0, (6, 3))
    sites = np.repeat(sites, 2, axis=0)
    sites[1::2] += apart_km * np.array([0.0, 0.6, 0.8])
    v = np.array([0.0, 3.07, 0.0]) + rng.normal(size=(6, 3)).repeat(2, axis=0) * spread_km_s
    place = sites + t[:, None, None] * v
    path = place - 7000.0 * flat[:, None]
    u = path / np.linalg.norm(path, axis=2, keepdims=True) + rng.normal(size=path.shape) * SIGMA
    seen = rng.random(u.shape[:2]) > 0.1
    offsets = np.concatenate([[0], np.cumsum(seen.sum(axis=1))])
    u = u / np.linalg.norm(u, axis=2, keepdims=True)
    return t, offsets, u[seen], np.tile(np.arange(12), (n_frames, 1))[seen]


def follow(t, offsets, u, flux=None):
    """Return the tracks of the detections of a ring."""
    return follow_detections(
        SkyDetections(t, offsets, u, np.full(len(u), SIGMA), flux), max_rate_rad_s=0.2,
        max_coast_s=4.5 * (t[1] - t[0]), max_missed=3, min_detections=3, gate_sigma=4.0,
        field_sr=0.005, false_alarm=1e-4,
    )  # fmt: skip


def mixed(track, who):
    """Return how many tracks are of several objects."""
    return sum(len(set(who[track == k])) > 1 for k in range(track.max() + 1))

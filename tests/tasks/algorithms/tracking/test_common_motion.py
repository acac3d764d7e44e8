"""Common motion: co-located satellites stay apart where frames are far apart."""

import numpy as np
import pytest

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.tracking import runs
from epipole.tasks.algorithms.tracking.common_motion import common_motion
from epipole.tasks.algorithms.tracking.runs import follow_detections

SIGMA = 1.2 * ARCSEC
NEIGHBOURS_KM = 14.0  # 70 arcsec


def ring(seed, every_s=30.0, n_frames=9, spread_km_s=0.005):
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
    sites[1::2] += NEIGHBOURS_KM * np.array([0.0, 0.6, 0.8])
    v = np.array([0.0, 3.07, 0.0]) + rng.normal(size=(6, 3)).repeat(2, axis=0) * spread_km_s
    place = sites + t[:, None, None] * v
    path = place - 7000.0 * flat[:, None]
    u = path / np.linalg.norm(path, axis=2, keepdims=True) + rng.normal(size=path.shape) * SIGMA
    seen = rng.random(u.shape[:2]) > 0.1
    offsets = np.concatenate([[0], np.cumsum(seen.sum(axis=1))])
    u = u / np.linalg.norm(u, axis=2, keepdims=True)
    return t, offsets, u[seen], np.tile(np.arange(12), (n_frames, 1))[seen]


def follow(t, offsets, u):
    return follow_detections(
        t, offsets, u, np.full(len(u), SIGMA), max_rate_rad_s=0.2, max_coast_s=4.5 * (t[1] - t[0]),
        max_missed=3, min_detections=3, gate_sigma=4.0, field_sr=0.005, false_alarm=1e-4,
    )  # fmt: skip


def mixed(track, who):
    """Return how many tracks are of several objects."""
    return sum(len(set(who[track == k])) > 1 for k in range(track.max() + 1))


def test_co_located_satellites_are_told_apart_at_30_s(monkeypatch):
    scenes = [ring(seed) for seed in range(6)]
    tracks = [follow(*scene[:3]) for scene in scenes]
    assert sum(mixed(track, scene[3]) for track, scene in zip(tracks, scenes, strict=True)) <= 1
    assert sum((track >= 0).sum() for track in tracks) > 0.97 * sum(len(s[3]) for s in scenes)
    monkeypatch.setattr(runs, "common_motion", lambda *_: None)
    alone = [follow(*scene[:3]) for scene in scenes]
    assert sum(mixed(track, scene[3]) for track, scene in zip(alone, scenes, strict=True)) > 10


def test_what_moves_alike_stands_nearly_still_in_its_frame_of_reference():
    t, offsets, u, who = ring(1)
    motion = common_motion(t, offsets, u, np.full(len(u), SIGMA), who)
    frame = np.repeat(np.arange(len(t)), np.diff(offsets))
    still = np.einsum("nij,nj->ni", motion.rotation[frame], u)
    for k in range(12):
        mine = who == k
        went = [np.linalg.norm(x[mine][-1] - x[mine][0]) for x in (u, still)]
        assert went[1] < 0.1 * went[0]
    np.testing.assert_allclose(np.linalg.det(motion.rotation), 1.0, rtol=1e-9)


def test_there_is_none_where_it_is_not_needed():
    t, offsets, u, who = ring(2, every_s=1.0)
    assert common_motion(t, offsets, u, np.full(len(u), SIGMA), who) is None


@pytest.mark.parametrize("changes", [{"spread_km_s": 3.0}, {"every_s": 10.0, "n_frames": 60}])
def test_no_detection_is_lost_where_motions_differ_or_tracks_were_whole(changes, monkeypatch):
    scenes = [ring(seed, **changes) for seed in range(3)]
    tracks = [follow(*scene[:3]) for scene in scenes]
    monkeypatch.setattr(runs, "common_motion", lambda *_: None)
    for track, scene in zip(tracks, scenes, strict=True):
        alone = follow(*scene[:3])
        assert mixed(track, scene[3]) <= mixed(alone, scene[3])
        assert (track >= 0).sum() >= (alone >= 0).sum() - 3 * (alone.max() - track.max())


def test_without_tracks_there_is_no_common_motion():
    t, offsets, u, who = ring(3)
    assert common_motion(t, offsets, u, np.full(len(u), SIGMA), np.full(len(u), -1)) is None
    assert common_motion(t, offsets, u, np.full(len(u), SIGMA), np.where(who < 2, who, -1)) is None

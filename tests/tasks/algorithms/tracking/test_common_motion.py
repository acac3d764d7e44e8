"""Common motion: co-located satellites stay apart where frames are far apart."""

import numpy as np
import pytest
from scenes.co_located import SIGMA, follow, mixed, ring

from epipole.tasks.algorithms.tracking import runs
from epipole.tasks.algorithms.tracking.common_motion import common_motion


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


def without_frames(blank, seed=0, n_frames=12):
    """Return times, offsets and directions of a ring, without detections in some frames."""
    t, offsets, u, _ = ring(seed, n_frames=n_frames)
    frame = np.repeat(np.arange(n_frames), np.diff(offsets))
    kept = ~np.isin(frame, blank)
    return t, np.searchsorted(frame[kept], np.arange(n_frames + 1)), u[kept]


def test_without_detections_in_successive_frames_at_the_beginning_there_is_no_common_motion():
    t, offsets, u = without_frames([1, 2, 3])
    track = follow(t, offsets, u)
    assert common_motion(t, offsets, u, np.full(len(u), SIGMA), track) is None
    assert (track >= 0).mean() > 0.9


@pytest.mark.parametrize("blank", [[0, 1, 2], [1], [2], [1, 3], [1, 2, 3, 4]])
def test_wherever_frames_are_empty_the_common_motion_is_finite_or_none(blank):
    t, offsets, u = without_frames(blank)
    motion = common_motion(t, offsets, u, np.full(len(u), SIGMA), follow(t, offsets, u))
    assert motion is None or np.isfinite(motion.rotation).all()

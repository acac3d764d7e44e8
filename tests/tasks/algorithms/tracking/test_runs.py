"""Tracking: slow and fast objects are followed through misses; false alarms make no tracks."""

import numpy as np
import pytest
from scenes.few_frames import FIELD_RAD, INTERVAL_S, few_frames, found_and_false

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.tracking.runs import SkyDetections, follow_detections

FIELD = np.radians(4.0)
SIGMA = 2 * ARCSEC


def scene(
    seed, *, n_objects, n_false, n_frames, rate_arcsec_s, missed=0.05, axis=(0.3, 0.5, 0.8),
    interval_s=1.0, times=None,
):  # fmt: skip
    """Return detections of objects on great circles among false alarms: frame times and offsets,
    directions, and the object of each."""
    rng = np.random.default_rng(seed)
    centre = np.array(axis) / np.linalg.norm(axis)
    basis = tangent_basis(centre)
    times = np.arange(n_frames) * interval_s if times is None else times
    start = rng.uniform(-FIELD / 2, FIELD / 2, (n_objects, 2))
    heading = rng.uniform(0, 2 * np.pi, n_objects)
    rate = rate_arcsec_s * ARCSEC * np.column_stack([np.cos(heading), np.sin(heading)])
    offsets, u, who = [0], [], []
    for t in times:
        place = np.vstack(
            [start + rate * t, rng.uniform(-FIELD / 2, FIELD / 2, (rng.poisson(n_false), 2))]
        )
        label = np.concatenate([np.arange(n_objects), np.full(len(place) - n_objects, -1)])
        kept = (rng.random(len(place)) > missed) & (np.abs(place) < FIELD / 2).all(axis=1)
        order = rng.permutation(np.flatnonzero(kept))
        place = place[order] + rng.normal(size=(len(order), 2)) * SIGMA
        u.append(centre + place @ basis)
        who.append(label[order])
        offsets.append(offsets[-1] + len(order))
    u = np.concatenate(u)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return times, np.array(offsets), u, np.concatenate(who)


def follow(times, offsets, u, sigma=SIGMA, **changes):
    options = {
        "max_rate_rad_s": np.radians(2.0),
        "max_coast_s": 4.5,
        "max_missed": 3,
        "min_detections": 3,
        "gate_sigma": 4.0,
        "field_sr": FIELD**2,
        "false_alarm": 1e-4,
    }
    seen = SkyDetections(times, offsets, u, np.full(len(u), sigma))
    return follow_detections(seen, **options | changes)


def score(track, who):
    """Share of tracked detections that are their track's object, of objects' that are tracked.

    Objects that barely touch the field, with fewer than six detections, are not asked for.
    """
    pure = sum(
        np.bincount(who[track == t][who[track == t] >= 0]).max(initial=0)
        for t in range(track.max(initial=-1) + 1)
    )
    count = np.bincount(who[who >= 0], minlength=1)
    asked = (who >= 0) & (count[who] >= 6)
    return pure / max((track >= 0).sum(), 1), pure / max(asked.sum(), 1)


@pytest.mark.parametrize("rate", [0.0, 40.0, 600.0])
@pytest.mark.parametrize("axis", [(0.3, 0.5, 0.8), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)])
def test_objects_are_followed_at_any_rate_and_anywhere_on_the_sky(rate, axis):
    times, offsets, u, who = scene(
        1, n_objects=10, n_false=10, n_frames=60, rate_arcsec_s=rate, axis=axis
    )
    purity, completeness = score(follow(times, offsets, u), who)
    assert purity > 0.995
    assert completeness > 0.98


def test_strays_alone_make_next_to_no_tracks():
    times, offsets, u, _ = scene(2, n_objects=0, n_false=40, n_frames=300, rate_arcsec_s=0)
    assert follow(times, offsets, u).max(initial=-1) + 1 <= 2


def test_an_object_missed_too_long_begins_a_new_track():
    times, offsets, u, _ = scene(
        3, n_objects=1, n_false=0, n_frames=60, rate_arcsec_s=40.0, missed=0.0
    )
    gone = np.zeros(len(u), bool)
    gone[15:45] = True
    offsets = np.concatenate([[0], np.cumsum(np.diff(offsets) * ~gone)])
    track = follow(times, offsets, u[~gone])
    assert track[:15].tolist() == [0] * 15
    assert track[15:].tolist() == [1] * 15


def test_an_hour_between_frames_ends_every_track():
    times, offsets, u, _ = scene(
        4, n_objects=1, n_false=0, n_frames=20, rate_arcsec_s=0.0, missed=0.0
    )
    times[10:] += 3600.0
    track = follow(times, offsets, u)
    assert track[0] == 0
    assert track[-1] == 1


def test_no_track_takes_a_false_alarm_from_behind_a_gap():
    """After three minutes, a prediction is so wide that it holds any false alarm."""
    for seed in range(6):
        times = np.arange(40.0) + 180.0 * (np.arange(40) >= 20)
        _, offsets, u, who = scene(
            seed, n_objects=6, n_false=5, n_frames=40, rate_arcsec_s=10.0, times=times
        )
        frame = np.repeat(np.arange(40), np.diff(offsets))
        track = follow(times, offsets, u)
        for t in range(track.max() + 1):
            assert len(set((frame[track == t] >= 20).tolist())) == 1
            assert (who[track == t] >= 0).all()


def test_short_bursts_of_frames_give_tracks_together():
    """Three detections say too little by themselves, among false alarms."""
    k = np.arange(45)
    times, offsets, u, who = scene(
        7, n_objects=6, n_false=5, n_frames=45, rate_arcsec_s=10.0, times=k // 3 * 10.0 + k % 3 / 2
    )
    track = follow(times, offsets, u, max_coast_s=2.25)
    purity, completeness = score(track, who)
    assert purity > 0.98
    assert completeness > 0.85


def test_all_detections_on_one_spot_are_no_trouble():
    u = np.tile([0.0, 0.0, 1.0], (50, 1))
    track = follow(np.arange(5.0), np.arange(6) * 10, u)
    assert len(track) == 50
    for f in range(5):  # never two detections of a frame in one track
        used = track[f * 10 : f * 10 + 10]
        used = used[used >= 0]
        assert len(set(used.tolist())) == len(used)


@pytest.mark.parametrize("n_frames", [0, 1, 2])
def test_few_frames_give_no_track(n_frames):
    u = np.tile([0.0, 0.0, 1.0], (n_frames, 1))
    track = follow(np.arange(float(n_frames)), np.arange(n_frames + 1), u)
    assert (track == -1).all()


def test_the_same_input_gives_the_same_tracks():
    times, offsets, u, _ = scene(5, n_objects=20, n_false=50, n_frames=30, rate_arcsec_s=40)
    assert (follow(times, offsets, u) == follow(times, offsets, u)).all()


@pytest.mark.parametrize("miss_km", [300.0, 500.0, 1000.0])
def test_an_object_that_comes_near_is_one_track(miss_km):
    """Two low orbits meet at 14 km/s: the range changes, and the rate with it, by far more than
    the rate itself would let one expect."""
    rng = np.random.default_rng(1)
    times = np.arange(-100, 100, 0.2)
    path = np.column_stack([14.0 * times, np.full(len(times), miss_km), 0.05 * miss_km + times])
    u = path / np.linalg.norm(path, axis=1, keepdims=True)
    u += rng.normal(size=u.shape) * SIGMA
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    kept = rng.random(len(times)) > 0.05
    rate = 14.0 * miss_km / np.sum(path**2, axis=1)
    kept &= rate < np.radians(1.5)
    track = follow(times[kept], np.arange(kept.sum() + 1), u[kept], max_coast_s=0.9)
    names, count = np.unique(track[track >= 0], return_counts=True)
    assert len(names) == (2 if rate.max() > np.radians(1.5) else 1)
    assert count.sum() > 0.99 * kept.sum()


@pytest.mark.parametrize("apart_arcsec", [60.0, 80.0])
def test_neighbours_seen_every_half_minute_are_not_exchanged(apart_arcsec):
    """In half a minute, the orbit of a low sensor moves objects by more than their distance."""
    rng = np.random.default_rng(4)
    times = np.arange(0.0, 1200.0, 30.0)
    n = len(times)
    angle = 1.1e-3 * times
    common = np.column_stack([45 * ARCSEC * times, np.zeros(n)])
    common += 0.2 * np.column_stack([np.cos(angle), np.sin(angle)])  # a low orbit, 36,000 km off
    apart = np.array([[0.0, 0.0], [0.8, 0.6]]) * apart_arcsec * ARCSEC
    centre = np.array([0.3, 0.5, 0.8]) / np.linalg.norm([0.3, 0.5, 0.8])
    place = (common[:, None] + apart).reshape(-1, 2) + rng.normal(size=(2 * n, 2)) * SIGMA
    u = centre + place @ tangent_basis(centre)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    track = follow(times, 2 * np.arange(n + 1), u, max_coast_s=135.0)
    for first in range(2):
        later = track[first::2][6:]  # the first three frames may join the two objects crosswise
        assert later[0] >= 0
        assert len(set(later.tolist())) == 1


@pytest.mark.parametrize("n_false", [0, 1, 5, 20])
def test_objects_in_five_frames_are_found_among_strays(n_false):
    """Five frames give less evidence than a rate of false tracks per frame would ask for."""
    found = asked = false = 0
    for seed in range(60):
        scene = few_frames(seed, 2, n_false, sigma_px=0.8)
        track = follow(*scene[:3], scene.sigma_rad[0], max_coast_s=4.5 * INTERVAL_S,
                       field_sr=FIELD_RAD.prod())  # fmt: skip
        counts = found_and_false(scene, track, 5)
        found, asked, false = found + counts[0], asked + counts[1], false + counts[2]
    assert asked == 120
    assert found >= 0.94 * asked
    assert false <= 0.1 * 60


@pytest.mark.parametrize("n_frames", [5, 15])
@pytest.mark.parametrize("n_false", [3, 10, 30])
def test_strays_of_few_frames_make_no_more_tracks_than_accepted(n_frames, n_false):
    false = 0
    for seed in range(60):
        scene = few_frames(seed, 0, n_false, n_frames=n_frames)
        track = follow(*scene[:3], scene.sigma_rad[0], max_coast_s=4.5 * INTERVAL_S,
                       field_sr=FIELD_RAD.prod())  # fmt: skip
        false += int(track.max(initial=-1)) + 1
    assert false <= 0.1 * 60  # accepted: one per sequence, of which a twentieth is measured


def test_more_frames_are_held_to_the_rate_per_frame():
    """Then a track has had frames enough to give the evidence."""
    scene = few_frames(1, 2, 20, n_frames=30)
    options = {"max_coast_s": 4.5 * INTERVAL_S, "field_sr": FIELD_RAD.prod()}
    tracks = [
        follow(*scene[:3], scene.sigma_rad[0], **options, false_alarm_sequence=accepted)
        for accepted in (1e-9, 1.0)
    ]
    assert (tracks[0] == tracks[1]).all()
    assert tracks[0].max() == 1


@pytest.mark.parametrize("seed", range(5))
def test_a_fast_track_that_loses_its_object_does_not_live_on_false_alarms(seed):
    """Its rate is soon unknown: a gate as wide as the image would always hold something."""
    times, offsets, u, who = scene(
        seed, n_objects=3, n_false=20, n_frames=60, rate_arcsec_s=4000.0, missed=0.1
    )
    track = follow(times, offsets, u, max_rate_rad_s=np.radians(12.0))
    for t in range(track.max(initial=-1) + 1):
        last = np.flatnonzero((track == t) & (who >= 0)).max(initial=-1)
        assert ((track == t) & (np.arange(len(track)) > last)).sum() <= 2


@pytest.mark.parametrize("seed", range(3))
def test_faint_objects_that_are_seen_now_and_then_are_followed(seed):
    times, offsets, u, who = scene(
        seed,
        n_objects=3,
        n_false=2,
        n_frames=100,
        rate_arcsec_s=300.0,
        missed=0.65,
        interval_s=0.25,
    )
    true = [np.flatnonzero(who == k) for k in range(3)]
    track = follow(times, offsets, u)
    for rows in true:
        if len(rows) >= 6:
            assert (np.bincount(track[rows] + 1)[1:].max()) > 0.5 * len(rows)
    assert score(track, who)[0] > 0.97


def test_a_precise_track_goes_on_through_misses_where_false_detections_are_few():
    times, offsets, u, who = scene(
        7, n_objects=1, n_false=2, n_frames=60, rate_arcsec_s=100.0, missed=0.0, interval_s=0.25
    )
    frame = np.repeat(np.arange(60), np.diff(offsets))
    gone = (who == 0) & (frame >= 30) & (frame < 37)
    offsets = np.searchsorted(frame[~gone], np.arange(61))
    track = follow(times, offsets, u[~gone])
    seen = track[who[~gone] == 0]
    assert (seen == seen[0]).all()
    assert seen[0] >= 0


def test_an_object_that_comes_straight_at_the_sensor_is_one_track():
    # It passes at 60 km with 10 km/s: its rate grows twentyfold within half a minute.
    times = np.arange(0.0, 29.0, 0.25)
    there = np.column_stack([300.0 - 10.0 * times, np.full(len(times), 60.0), 0.0 * times])
    u = there / np.linalg.norm(there, axis=1, keepdims=True)
    u += np.random.default_rng(8).normal(size=u.shape) * SIGMA * 5
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    track = follow(
        times, np.arange(len(times) + 1), u, sigma=5 * SIGMA, max_rate_rad_s=np.radians(12.0),
        max_coast_s=1.2,
    )  # fmt: skip
    assert np.bincount(track + 1)[1:].max() >= 0.9 * len(times)

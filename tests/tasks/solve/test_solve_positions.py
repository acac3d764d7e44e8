"""Solve positions: which rows share no detection."""

import itertools

import numpy as np
from scenes.associations import filled

from epipole.schemas.bridge import array
from epipole.schemas.settings import Settings
from epipole.schemas.spans import Span
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.solve.solve_positions import solve_positions

T0 = 1_554_091_200_000_000_000
SECOND_NS = 1_000_000_000
PLACE_KM = np.array([42164.0, 0.0, 0.0])
SENSORS_KM = np.array([[7000.0, 0.0, 0.0], [0.0, 7000.0, 0.0]])
PHASE_NS = np.array([0, 400_000_000])  # of each sensor's frames, which come every second


def night(n_epochs, half_s):
    """Views of one object by two sensors, every second, and the frames that each is fitted to."""
    epoch, sensor = (a.ravel() for a in np.meshgrid(np.arange(n_epochs), [0, 1], indexing="ij"))
    u = PLACE_KM - SENSORS_KM[sensor]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    first = np.maximum(epoch - half_s, 0) * SECOND_NS + PHASE_NS[sensor]
    last = (epoch + half_s) * SECOND_NS - PHASE_NS[sensor]
    last = (last - PHASE_NS[sensor]) // SECOND_NS * SECOND_NS + PHASE_NS[sensor]
    views = filled(VIEWS, len(epoch), {
        "epoch": T0 + epoch * SECOND_NS, "sensor_id": np.array(["a", "b"])[sensor],
        "tracklet_id": np.array(["a-1", "b-1"])[sensor],
        "first_fitted": T0 + first, "last_fitted": T0 + last,
        **{f"u{a}": u[:, i] for i, a in enumerate("xyz")},
        **{f"{a}_km": SENSORS_KM[sensor, i] for i, a in enumerate("xyz")},
        **{f"cov_noise_{ab}_rad2": np.full(len(u), v) for ab, v in (("11", 1e-10), ("22", 1e-10))},
        "position_sigma_km": np.full(len(u), 0.02), "pixel_rad": np.full(len(u), 1e-4),
    })  # fmt: skip
    return views, np.zeros(len(epoch), np.int64)


def detections_of(views, positions, independent=True):
    """The detections of each position that is independent, or of each that is not."""
    kept = array(positions, "epoch")[array(positions, "independent") == independent]
    epoch, sensor = array(views, "epoch"), array(views, "sensor_id")
    first, last = array(views, "first_fitted"), array(views, "last_fitted")
    return [
        {
            (sensor[i], t)
            for i in np.flatnonzero(epoch == at)
            for t in range(first[i], last[i] + 1, SECOND_NS)
        }
        for at in kept
    ]


def test_independent_positions_share_no_detection_and_all_others_share_one():
    views, number = night(61, 6)
    positions = solve_positions(views, number, Settings()).positions
    used = detections_of(views, positions)
    assert all(a.isdisjoint(b) for a, b in itertools.combinations(used, 2))
    assert array(positions, "independent").sum() == len(used) == 5  # 0 to 6 s, 7 to 19 s, ...
    others = detections_of(views, positions, independent=False)
    assert all(any(a & b for b in used) for a in others)


def test_independent_positions_of_neighbouring_spans_share_no_detection():
    views, number = night(121, 6)
    used = []
    for half in (0, 1):
        span = Span(T0 + half * 60 * SECOND_NS, T0 + (half + 1) * 60 * SECOND_NS)
        used += detections_of(views, solve_positions(views, number, Settings(), span).positions)
    assert all(a.isdisjoint(b) for a, b in itertools.combinations(used, 2))
    assert len(used) == 9  # five, and from 60 s on four

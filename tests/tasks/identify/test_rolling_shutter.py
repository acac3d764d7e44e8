"""Rolling shutter: attitudes, stars and directions of objects against a simulated truth."""

import numpy as np
import polars as pl
import pytest
from scenes.watched_objects import errors, made_of, sights_of
from scipy.spatial.transform import Rotation

from epipole.flows.simulate import simulate
from epipole.io.logs.reader import read_log_pieces
from epipole.schemas.bridge import array, stack, stack_covariance
from epipole.schemas.scene import validate_scene
from epipole.schemas.settings import Assumption
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.turning import (
    ANY_RATE,
    angular_rates,
    rates_within_frames,
    turned,
)
from epipole.tasks.read.assume_readings import as_assumed

LINE_S = 1e-4  # an image of 1024 rows takes a tenth of a second
SEEN = {"a_km": 7378.0, "i_deg": 70.0, "raan_deg": 2.0, "true_anomaly_deg": 0.0}
SENSORS = [
    # Turns by 0.1 deg while an image is read: 13 px. Few stars.
    {
        "id": "spins",
        "orbit": {"a_km": 42164.0, "i_deg": 60.0},
        "camera": {"fov_deg": 8.0, "line_time_s": LINE_S},
        "pointing": {"mode": "spin", "ra_deg": 80.0, "dec_deg": 10.0, "axis": [0.2, -0.5, 0.7],
                     "rate_deg_s": 1.0},
        "magnitude_limit": 6.5,
        "rate_hz": 2.0,
    },
    # Looks where objects pass, at 7 km/s.
    {
        "id": "watches",
        "orbit": {"a_km": 6978.0, "i_deg": 60.0, "raan_deg": 4.0, "true_anomaly_deg": 3.0},
        "camera": {"fov_deg": 15.0, "line_time_s": LINE_S},
        "pointing": {"mode": "track", "place_km": [7372.8, 272.6, 41.4], "roll_deg": 20.0},
        "magnitude_limit": 6.0,
        "rate_hz": 5.0,
    },
]  # fmt: skip


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    defaults = {"detection": {"sigma_px": 0.15, "false_points": 5.0, "star_drop": 0.05},
                "states": {"position_noise_km": 0.0, "position_bias_km": 0.0}}  # fmt: skip
    target = {"orbit": SEEN, "count": 8, "spread_km": 40.0, "magnitude": [4.0, 5.5]}
    scene = {"name": "rolling", "start": "2026-03-01T02:00:00Z", "duration_s": 12.0, "seed": 2,
             "sensor_defaults": defaults, "sensors": SENSORS, "targets": [target]}  # fmt: skip
    path = tmp_path_factory.mktemp("rolling") / "night.mcap"
    simulate(validate_scene(scene, "test"), path)
    return path


def true_frames(log, sensor_id):
    frames = pl.read_parquet(f"{log}.truth/frames.parquet")
    return frames.filter(pl.col("sensor_id") == sensor_id).sort("frame_number")


def turns(solutions, frames):
    """Return the errors of attitudes over their covariance: squares that should average 3."""
    got, true = Rotation.from_quat(stack(solutions, "q{}", "xyzw")), Rotation.from_quat(
        frames.select(f"q{a}" for a in "xyzw").to_numpy()
    )  # fmt: skip
    off = (got * true.inv()).as_rotvec() / ARCSEC
    cov = stack_covariance(solutions, "cov_att_{}_arcsec2")
    return np.einsum("ni,nij,nj->n", off, np.linalg.inv(cov), off)


@pytest.mark.parametrize("sensor_id", ["spins", "watches"])
def test_attitudes_are_right_and_honest(log, sensor_id):
    found, _ = made_of(log, sensor_id)
    frames = true_frames(log, sensor_id)
    assert array(found.solutions, "attitude_source").tolist() == ["stars"] * len(frames)
    square = turns(found.solutions, frames)
    assert 2.0 < square.mean() < 4.2
    assert np.sqrt(np.mean(array(found.stars, "dx_px") ** 2)) < 0.16
    assert np.sqrt(np.mean(array(found.stars, "dy_px") ** 2)) < 0.16


def test_without_the_line_time_stars_are_pixels_off(log):
    found, _ = made_of(log, "spins", line_time_s=0.0)
    off = np.hypot(array(found.stars, "dx_px"), array(found.stars, "dy_px"))
    assert not len(off) or np.median(off) > 1.0


def test_objects_are_where_they_were_when_their_rows_were_exposed(log):
    seen, source = sights_of(log, "watches")
    assert len(seen) > 300
    late_ns = np.abs(array(seen, "time")[:, None] - true_frames(log, "watches")["t_ns"].to_numpy())
    assert late_ns.min(axis=1).max() > 1e7  # rows are up to 50 ms before or after the frame
    off, sigma = errors(log, seen, source)
    assert 0.85 < np.mean(off**2 / sigma**2) < 1.15
    # Without the line time, they are where they were at other times.
    wrong, _ = errors(log, *sights_of(log, "watches", line_time_s=0.0))
    assert np.mean(wrong**2) > 6 * np.mean(off**2)


def test_a_line_time_can_be_assumed(log):
    (piece, *_) = read_log_pieces(log)
    assumed = Assumption(sensor="spins", line_time_s=2e-5)
    lines = as_assumed(piece, [assumed]).cameras.select(["sensor_id", "line_time_s"]).to_pylist()
    assert {row["sensor_id"]: row["line_time_s"] for row in lines} == {
        "spins": 2e-5, "watches": LINE_S,
    }  # fmt: skip


# Rates from attitudes.

RATE = np.array([0.01, -0.02, 0.005])


def attitudes(t_s, rate=RATE):
    first = Rotation.from_quat([0.1, 0.7, -0.3, 0.64])
    return (Rotation.from_rotvec(np.outer(t_s, rate)) * first).as_matrix()


def test_the_rate_of_a_sensor_that_turns_evenly_is_found_in_all_frames():
    t_s = np.array([0.0, 0.4, 1.0, 1.3, 2.0, 2.1])
    known = np.array([False, True, True, False, True, True])
    R = attitudes(t_s)
    R[~known] = np.nan
    assert np.allclose(angular_rates(t_s, R, known), RATE, atol=1e-12)


def test_a_jump_is_no_rate():
    t_s = np.arange(6.0)
    R = attitudes(t_s)
    R[3:] = R[3:] @ Rotation.from_rotvec([0.3, 0.0, 0.0]).as_matrix()
    assert np.allclose(angular_rates(t_s, R, np.ones(6, bool)), RATE, atol=1e-9)


def slow_log(folder, rate_deg_s, rate_hz=0.05, duration_s=301.0):
    """Write a log of a sensor that turns and has a frame in 20 s, or one only."""
    defaults = {"detection": {"sigma_px": 0.15, "false_points": 3.0, "star_drop": 0.05}}
    spin = SENSORS[0]["pointing"] | {"rate_deg_s": rate_deg_s}
    sensor = SENSORS[0] | {"pointing": spin, "rate_hz": rate_hz, "magnitude_limit": 7.0}
    scene = {"name": "slow", "start": "2026-03-01T02:00:00Z", "duration_s": duration_s, "seed": 5,
             "sensor_defaults": defaults, "sensors": [sensor]}  # fmt: skip
    simulate(validate_scene(scene, "test"), folder / "slow.mcap")
    return folder / "slow.mcap"


@pytest.mark.parametrize("rate_deg_s", [0.0, 0.2, 1.0, 3.0])
def test_where_frames_are_far_apart_their_stars_tell_the_rate(rate_deg_s, tmp_path):
    log = slow_log(tmp_path, rate_deg_s)
    found, _ = made_of(log, "spins")
    frames = true_frames(log, "spins")
    assert array(found.solutions, "attitude_source").tolist() == ["stars"] * len(frames)
    assert 1.6 < turns(found.solutions, frames).mean() < 4.8  # of 16 frames: 3 +- 0.6


def test_the_stars_of_a_single_frame_tell_its_rate(tmp_path):
    log = slow_log(tmp_path, 1.0, rate_hz=1.0, duration_s=0.9)
    found, _ = made_of(log, "spins")
    assert array(found.solutions, "attitude_source").tolist() == ["stars"]
    assert turns(found.solutions, true_frames(log, "spins"))[0] < 16.3  # 0.1 % of the right ones


def test_turns_and_rates_of_frames_have_honest_errors():
    rng, n, per, sigma = np.random.default_rng(4), 1000, 6, 1e-4
    frame = np.repeat(np.arange(n), per)
    x, y = rng.uniform(-0.1, 0.1, (2, n * per))
    u = np.stack([x, y, np.ones_like(x)], axis=1)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    late_s = 0.5 * y + 0.02  # the middle row is exposed later than the frame's time
    turn, rate = rng.normal(0, 1e-4, (n, 3)), rng.normal(0, ANY_RATE, (n, 3))
    noise = rng.normal(0, sigma, (n * per, 3))
    off = np.cross(turn[frame] + rate[frame] * late_s[:, None], u)
    off += noise - np.sum(noise * u, axis=1, keepdims=True) * u
    found = rates_within_frames(frame, u, off, late_s, np.full(n * per, sigma), n + 1)
    error = found.turn_rad[:n] - turn
    square = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.cov_rad2[:n]), error)
    assert 2.8 < square.mean() < 3.2
    alone = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.cov_alone[:n]), error)
    assert alone.mean() > 2 * square.mean()
    assert not any(np.any(values[n]) for values in found)  # without stars


@pytest.mark.parametrize("t_s", [[0.0], [0.0, 60.0]])
def test_frames_far_apart_tell_no_rate(t_s):
    t_s = np.array(t_s)
    assert not angular_rates(t_s, attitudes(t_s), np.ones(len(t_s), bool)).any()


def test_directions_turn_as_the_attitude_does():
    u = np.array([[0.6, 0.0, 0.8], [0.0, -0.28, 0.96]])
    before, after = attitudes(np.array([0.0, 0.5]))
    assert np.allclose(turned(u @ before.T, np.tile(0.5 * RATE, (2, 1))), u @ after.T, atol=1e-12)

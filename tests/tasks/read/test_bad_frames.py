"""Frames out of order, repeated, missing or full of strays: read, identified and tracked."""

import numpy as np
import pyarrow.compute as pc
import pytest
from scenes.identified import identified, tracked
from scenes.whole_logs import read_whole

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.io.logs.writer import LogWriter
from epipole.schemas.settings import Settings
from epipole.tasks.identify.frame_inputs import interpolate_sensor_states

START_NS = 1_554_091_200_000_000_000
OPTICS = {
    "width": 1024, "height": 1024, "fx_px": 7000.0, "fy_px": 7000.0, "cx_px": 511.5,
    "cy_px": 511.5, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0,
}  # fmt: skip
SETTINGS = Settings()
SENSOR_STATES_AT_FRAMES = np.array([[200.0, 300.0], [500.0, 600.0], [800.0, 350.0]])
SPEEDS = np.array([[1.5, 0.7], [-1.1, 0.9], [0.6, -1.3]])  # px per frame
SIGMA = 0.15


def frame(number, at_s=None, strays=0):
    """A frame of three objects in uniform motion: number, time [s] and places."""
    at_s = float(number) if at_s is None else at_s
    rng = np.random.default_rng(number)
    place = SENSOR_STATES_AT_FRAMES + SPEEDS * (at_s % 600) + rng.normal(size=(3, 2)) * SIGMA
    return number, at_s, np.concatenate([place, rng.uniform(0, 1023, (strays, 2))])


def track(tmp_path, frames):
    """Write and track a log of one sensor with a prior attitude; return its tables, and the log."""
    path = tmp_path / "bad.mcap"
    last = max((at for _, at, _ in frames), default=0.0)
    with LogWriter(path) as log:
        log.camera("a", START_NS, OPTICS)
        for t in np.arange(-10.0, last + 20, 10.0):
            log.state(
                "a", START_NS + int(t * 1e9), position_km=[42164.0, 3.07 * t, 0.0],
                velocity_km_s=[0.0, 3.07, 0.0], attitude_xyzw=[0.0, 0.0, 0.0, 1.0],
                attitude_sigma_arcsec=30.0,
            )  # fmt: skip
        for number, at, places in frames:
            log.frame(
                "a", START_NS + int(at * 1e9), frame_number=number, exposure_s=0.1,
                x_px=places[:, 0], y_px=places[:, 1], sigma_px=np.full(len(places), SIGMA),
            )  # fmt: skip
    read = read_whole([str(path)], SETTINGS)
    places = interpolate_sensor_states(read.exposures, read.states, SETTINGS.sensors)
    found = identified(read.exposures, places, read.cameras, read_hipparcos(), SETTINGS)
    return tracked(found.solutions, found.detections, read.cameras, SETTINGS), read


@pytest.fixture(scope="module")
def good(tmp_path_factory):
    built, _ = track(tmp_path_factory.mktemp("good"), [frame(k) for k in range(40)])
    assert built.tracklets["n_detections"].to_pylist() == [40] * 3
    return built


def test_frames_out_of_order_are_put_in_order(good, tmp_path):
    order = np.random.default_rng(0).permutation(40)
    built, _ = track(tmp_path, [frame(int(k)) for k in order])
    assert built.tracklets.equals(good.tracklets)
    assert built.detections.equals(good.detections)


def test_a_frame_that_comes_twice_counts_once(good, tmp_path):
    built, _ = track(tmp_path, [frame(k // 2) for k in range(80)])
    assert built.tracklets.equals(good.tracklets)
    assert built.detections.equals(good.detections)


def test_two_frames_at_one_time_give_no_infinite_rate(tmp_path):
    frames = [frame(k, float(k - (k > 20))) for k in range(41)]  # 20 and 21 at 20 s
    built, read = track(tmp_path, frames)
    assert built.tracklets.num_rows == 3
    left_out = pc.sum(read.rejects["count"]).as_py() or 0
    assert min(built.tracklets["n_detections"].to_pylist()) >= 41 - left_out - 1
    assert np.isfinite(built.tracklets["rate_arcsec_s"].to_numpy()).all()
    assert max(built.tracklets["residual_px"].to_pylist()) < 0.3


def test_frames_that_all_have_one_time_give_no_tracklets(tmp_path):
    built, _ = track(tmp_path, [frame(k, 5.0) for k in range(40)])
    assert built.tracklets.num_rows == 0


def test_a_gap_of_an_hour_ends_the_tracks(tmp_path):
    frames = [frame(k) for k in range(20)] + [frame(k, 3600.0 + k) for k in range(20, 40)]
    built, _ = track(tmp_path, frames)
    assert built.tracklets["n_detections"].to_pylist() == [20] * 6
    assert len(set(built.tracklets["track_id"].to_pylist())) == 6


@pytest.mark.long
def test_ten_thousand_strays_in_one_frame_break_no_track(tmp_path):
    built, _ = track(tmp_path, [frame(k, strays=10_000 * (k == 17)) for k in range(40)])
    assert built.tracklets.num_rows == 3
    assert min(built.tracklets["n_detections"].to_pylist()) >= 39
    assert built.detections.num_rows == 120 + 10_000
    assert max(built.tracklets["residual_px"].to_pylist()) < 0.3


@pytest.mark.parametrize("frames", [[frame(0)], [frame(0), frame(1)]])
def test_one_or_two_frames_give_detections_and_no_tracklets(tmp_path, frames):
    built, _ = track(tmp_path, frames)
    assert built.detections["kind"].to_pylist() == ["unknown"] * 3 * len(frames)
    assert built.tracklets.num_rows == 0


def test_empty_frames_give_empty_tables(tmp_path):
    nothing = [(k, float(k), np.zeros((0, 2))) for k in range(10)]
    built, _ = track(tmp_path, nothing)
    assert built.detections.num_rows == built.tracklets.num_rows == 0

"""Place sensors: at the times of their frames, and as the truth of the sample logs has them."""

from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scenes.cameras import cameras_of
from scenes.whole_logs import read_whole

from epipole.io.logs.writer import LogWriter
from epipole.schemas.bridge import array, stack, table
from epipole.schemas.settings import Settings
from epipole.schemas.work_tables import EXPOSURES
from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.identify.frame_inputs import (
    flatten_centroids,
    interpolate_sensor_states,
    repeats,
)

START_NS = 1_554_091_200_000_000_000
SECOND_NS = 1_000_000_000
CAMERA = Camera(512, 512, 1000.0, 1000.0, 255.5, 255.5)
LOGS = Path(__file__).resolve().parents[4] / "shared" / "data" / "logs"


def write(path, sensors, n=5, **state):
    with LogWriter(path) as log:
        for k, sensor_id in enumerate(sensors):
            for i in range(n):
                time_ns = START_NS + i * SECOND_NS
                if state:
                    log.state(
                        sensor_id, time_ns, position_km=[7000.0 + 500 * k, 7.5 * i, 0.0], **state
                    )
                log.frame(sensor_id, time_ns, frame_number=i, exposure_s=0.0, x_px=[1], y_px=[1])
    return path


def place(path, settings=None):
    log = read_whole([path], Settings())
    return log, interpolate_sensor_states(
        log.exposures, log.states, (settings or Settings()).sensors
    )


def test_places_go_row_by_row_with_the_exposures(tmp_path):
    log, places = place(write(tmp_path / "a.mcap", ["b", "a"], velocity_km_s=[0.0, 7.5, 0.0]))
    for name in ("sensor_id", "frame_number", "time"):
        assert places[name].equals(log.exposures[name])
    np.testing.assert_allclose(array(places, "x_km"), [7500.0] * 5 + [7000.0] * 5, atol=1e-9)


def test_of_centroids_at_one_position_of_a_frame_the_brightest_counts():
    frame = np.array([0, 0, 0, 0, 0, 1, 1, 1])
    x, y = np.array([[5, 5, 5, 7, 5, 5, 8, 8], [6, 6, 7, 6, 6, 6, 1, 1]], float)
    flux = np.array([2.0, 3.0, 9.0, 9.0, np.nan, 1.0, np.nan, np.nan])
    assert np.flatnonzero(repeats(frame, x, y, flux)).tolist() == [0, 4, 7]
    assert not repeats(frame[:0], x[:0], y[:0], flux[:0]).any()


def test_a_missing_centroid_sigma_is_the_median_of_the_sensors_others():
    key = {"sensor_id": ["a"] * 3, "frame_number": [0, 1, 2], "time": [0, 1, 2]}
    lists = {"x_px": [[1.0], [2.0], [3.0]], "y_px": [[1.0], [2.0], [3.0]]}
    rest = {"exposure_s": [0.0] * 3, "flux": [None] * 3, "source": ["a"] * 3, "offset": [0] * 3}
    for stated, expected in [([[0.2], None, [0.4]], [0.2, 0.3, 0.4]), ([None] * 3, [np.nan] * 3)]:
        exposures = table(EXPOSURES, key | lists | rest | {"sigma_px": stated})
        found = flatten_centroids(exposures, cameras_of({"a": CAMERA}), Settings().sensors)
        np.testing.assert_allclose(found.sigma_px, expected)


def test_unknown_sigmas_are_those_of_the_settings(tmp_path):
    sent = {"velocity_km_s": [0.0, 7.5, 0.0], "attitude_xyzw": [0.0, 0.0, 0.0, 1.0]}
    settings = Settings.model_validate(
        {"sensors": {"position_sigma_km": 0.7, "attitude_sigma_arcsec": 9.0}}
    )
    _, places = place(write(tmp_path / "a.mcap", ["a"], **sent), settings)
    assert array(places, "used_position_sigma_km").tolist() == [0.7] * 5
    assert places["position_sigma_km"].null_count == 5  # only what the log tells
    assert array(places, "attitude_sigma_arcsec").tolist() == [9.0] * 5
    sent |= {"position_sigma_km": 0.1, "attitude_sigma_arcsec": 3.0}
    _, places = place(write(tmp_path / "b.mcap", ["a"], **sent), settings)
    np.testing.assert_allclose(array(places, "position_sigma_km"), 0.1)
    np.testing.assert_allclose(array(places, "used_position_sigma_km"), 0.1)
    assert array(places, "attitude_sigma_arcsec").tolist() == [3.0] * 5


def test_a_sensor_without_states_has_nulls(tmp_path):
    _, places = place(write(tmp_path / "a.mcap", ["a"]))
    assert places.num_rows == 5
    for name in places.column_names[3:]:
        assert places[name].null_count == 5


@pytest.mark.skipif(not LOGS.exists(), reason="the sample logs are not at hand")
@pytest.mark.parametrize(
    "name", ["four_sensors_2deg", "six_sensors_8deg_no_prior", "lost_in_space_20deg"]
)
def test_places_of_the_sample_logs_are_those_of_their_truth(name):
    _, places = place(LOGS / f"{name}.mcap")
    truth = pq.read_table(LOGS / f"{name}.mcap.truth" / "frames.parquet")
    key = [("sensor_id", "ascending"), ("t_ns", "ascending")]
    truth = truth.sort_by(key)
    assert truth["t_ns"].to_pylist() == array(places, "time").tolist()
    off_km = stack(places, "{}_km") - stack(truth, "{}")
    sigma_km = array(places, "used_position_sigma_km")
    # Errors are a bias of each sensor and noise of each state; where neither was added, metres.
    assert np.sqrt(np.mean((off_km / sigma_km[:, None]) ** 2)) < 1.6
    assert np.abs(stack(places, "v{}_km_s") - stack(truth, "v{}")).max() < 1e-5


def test_states_that_give_an_impossible_speed_give_no_position(tmp_path):
    """Without velocities: 60 km from one nanosecond to the next."""
    with LogWriter(tmp_path / "a.mcap") as log:
        for i in range(5):
            log.state("a", START_NS + i, position_km=[7000.0, 60.0 * i, 0.0])
            log.frame(
                "a", START_NS + i * SECOND_NS, frame_number=i, exposure_s=0.0, x_px=[1], y_px=[1]
            )
    _, places = place(tmp_path / "a.mcap")
    for name in ("x_km", "vx_km_s", "position_sigma_km", "used_position_sigma_km"):
        assert places[name].null_count == 5, name

"""Order frames: those of several logs together, each once, whatever the order of the logs."""

import logging
import sys
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest
from scenes.whole_logs import read_whole

from epipole.io.logs.writer import LogWriter
from epipole.io.work.parts import LOG_PIECE, write_part
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.bridge import array, stack, table
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS
from epipole.schemas.work_tables import CAMERAS, LogSource
from epipole.tasks.read.order_frames import OrderPlan, frames_between, order_logs, ordered_logs
from epipole.tasks.read.read_logs import ReadLog, read_log_into

START_NS = 1_554_091_200_000_000_000
SECOND_NS = 1_000_000_000
LOGS = Path(__file__).resolve().parents[4] / "shared" / "data" / "logs"
CAMERA = dict.fromkeys(("cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3"), 0.0)
CAMERA |= {"width": 100, "height": 100, "fx_px": 500.0, "fy_px": 500.0}


def write(path, sensor_id, frames, *, states=(), frame="GCRF", sigma_km=0.0, camera_ns=()):
    """Write a log: frames as (second, number), states as seconds."""
    with LogWriter(path) as log:
        for time_ns in camera_ns:
            log.camera(sensor_id, time_ns, CAMERA)
        for second in states:
            log.state(
                sensor_id,
                START_NS + second * SECOND_NS,
                frame=frame,
                position_km=[7000.0, second % 1000, 0.0],
                position_sigma_km=sigma_km,
            )
        for second, number in frames:
            log.frame(
                sensor_id,
                START_NS + second * SECOND_NS,
                frame_number=number,
                exposure_s=0.1,
                x_px=[number],
                y_px=[second % 1000],
            )
    return path


def read(*paths):
    return read_whole(list(paths), Settings())


def rows(log):
    return [
        (row["reason"], row["sensor_id"], row["source"], row["count"])
        for row in log.rejects.drop_columns("time").to_pylist()
    ]


def test_frames_of_all_logs_are_sorted_by_sensor_and_time(tmp_path):
    b = write(tmp_path / "b.mcap", "sat2", [(3, 1), (1, 0)])
    a = write(tmp_path / "a.mcap", "sat1", [(2, 5)])
    log = read(b, a)
    assert log.exposures["sensor_id"].to_pylist() == ["sat1", "sat2", "sat2"]
    assert array(log.exposures, "frame_number").tolist() == [5, 0, 1]
    assert [source.name for source in log.sources] == ["a.mcap", "b.mcap"]
    assert log.sources[1].first_time_ns == START_NS + SECOND_NS


def test_frames_between_two_instants_come_from_all_logs_in_order(tmp_path):
    a = write(tmp_path / "a.mcap", "s", [(i, i) for i in range(6)], states=range(6))
    b = write(tmp_path / "b.mcap", "s", [(i, i) for i in range(4, 9)])
    between = START_NS + 3 * SECOND_NS, START_NS + 7 * SECOND_NS
    log = read_whole([b, a], Settings(), between)
    assert array(log.exposures, "frame_number").tolist() == [3, 4, 5, 6]
    assert [(reason, n) for reason, _, _, n in rows(log)] == [("duplicate_frame", 2)]
    assert log.states.num_rows == 3


def test_lists_of_centroids_stay_with_their_frames(tmp_path):
    order = np.random.default_rng(0).permutation(300)
    for name, part in (("a", order[:100]), ("b", order[100:])):
        with LogWriter(tmp_path / f"{name}.mcap", chunk_size=2000) as log:
            for number in part.tolist():
                x = np.full(number % 4, number, np.float32)
                flux = None if number % 3 else x + 1
                time_ns = START_NS + number * SECOND_NS
                log.frame(
                    f"s{number % 2}",
                    time_ns,
                    frame_number=number,
                    exposure_s=1.0,
                    x_px=x,
                    y_px=x,
                    flux=flux,
                )
    log = read(tmp_path / "b.mcap", tmp_path / "a.mcap")
    numbers = array(log.exposures, "frame_number").tolist()
    assert numbers == [*range(0, 300, 2), *range(1, 300, 2)]
    assert log.exposures["x_px"].to_pylist() == [[float(n)] * (n % 4) for n in numbers]
    expected = [None if n % 3 or not n % 4 else [n + 1.0] * (n % 4) for n in numbers]
    assert log.exposures["flux"].to_pylist() == expected
    assert log.exposures["sigma_px"].null_count == 300


def test_overlapping_logs_give_each_frame_and_state_once_in_any_order(tmp_path):
    a = write(tmp_path / "a.mcap", "s", [(i, i) for i in range(6)], states=range(6))
    b = write(tmp_path / "b.mcap", "s", [(i, i) for i in range(4, 9)], states=range(4, 9))
    log = read(a, b)
    assert array(log.exposures, "frame_number").tolist() == list(range(9))
    assert stack(log.states, "{}_km")[:, 1].tolist() == list(range(9))
    assert rows(log) == [
        ("duplicate_frame", "s", "b.mcap", 2),
        ("duplicate_state", "s", "b.mcap", 2),
    ]
    other = read(b, a)
    assert all(mine.equals(yours) for mine, yours in zip(log[:3], other[:3], strict=True))
    assert log.rejects.equals(other.rejects)
    assert log.sources == other.sources


@pytest.mark.parametrize("names", [("a", "b"), ("b", "a")])
def test_of_two_logs_with_states_of_the_same_times_those_with_attitudes_are_kept(tmp_path, names):
    attitudes = ([0.0, 0.0, 0.0, 1.0], None)
    paths = [tmp_path / f"{name}.mcap" for name in names]
    for path, q, sigma_km in zip(paths, attitudes, (5.0, 0.01), strict=True):
        with LogWriter(path) as log:
            log.frame("s", START_NS, frame_number=0, exposure_s=0.1, x_px=[1.0], y_px=[1.0])
            for k in range(5):
                log.state("s", START_NS + k * SECOND_NS, frame="GCRF", attitude_xyzw=q,
                          position_km=[7000.0, k, 0.0], position_sigma_km=sigma_km)  # fmt: skip
    log = read(*paths)
    assert log.states["qx"].null_count == 0
    assert array(log.states, "position_sigma_km").tolist() == [5.0] * 5
    assert ("duplicate_state", "s", f"{names[1]}.mcap", 5) in rows(log)


def test_after_a_restart_of_the_counter_numbers_go_on(tmp_path):
    a = write(tmp_path / "a.mcap", "s", [(0, 0), (1, 1), (2, 2), (10, 0), (11, 1), (12, 7)])
    log = read(a)
    assert array(log.exposures, "frame_number").tolist() == [0, 1, 2, 3, 4, 10]
    assert rows(log) == [("restarted_counter", "s", "a.mcap", 3)]
    assert array(log.rejects, "time").tolist() == [START_NS + 10 * SECOND_NS]


def test_a_counter_that_was_first_recorded_later_may_restart_below_that(tmp_path):
    run = [*range(3, 50), *range(60)]
    log = read(write(tmp_path / "a.mcap", "s", list(enumerate(run))))
    assert array(log.exposures, "frame_number").tolist() == [*range(3, 50), *range(50, 110)]
    assert rows(log) == [("restarted_counter", "s", "a.mcap", 60)]


def test_logs_that_each_count_from_zero_are_one_sensor(tmp_path):
    a = write(tmp_path / "a.mcap", "s", [(i, i) for i in range(5)])
    b = write(tmp_path / "b.mcap", "s", [(i + 5, i) for i in range(5)])
    log = read(b, a)
    assert array(log.exposures, "frame_number").tolist() == list(range(10))
    assert rows(log) == [("restarted_counter", "s", "b.mcap", 5)]


def test_the_numbers_of_a_night_do_not_depend_on_the_nights_before(tmp_path):
    midnight_s, near_s = 20 * 3600, 20 * 3600 - 600  # after 04:00
    before = [*enumerate(range(30)), *((40 + k, k) for k in range(20))]
    before += [(near_s + k, 20 + k) for k in range(5)]
    night = [(midnight_s + k, 25 + k) for k in range(10)]
    night += [(midnight_s + 900 + k, k) for k in range(30)]
    logs = [write(tmp_path / f"{k}.mcap", "s", of) for k, of in enumerate((before, night))]
    read = [read_log_into(ReadFolder(tmp_path), k, str(log)) for k, log in enumerate(logs)]
    day = START_NS // DAY_NS

    def numbers(day, since_s):
        folder = ReadFolder(tmp_path, day)
        since_ns = START_NS + since_s * SECOND_NS
        found = frames_between(folder, 0, since_ns, since_ns + 3600 * SECOND_NS)
        return array(found, "frame_number").tolist()

    frames = order_logs(ReadFolder(tmp_path), read, Settings().sensors)
    assert numbers(day, near_s)[:5] == [50, 51, 52, 53, 54]
    assert numbers(day + 1, near_s)[:5] == [20, 21, 22, 23, 24]  # in the margin of that night
    assert numbers(day + 1, midnight_s) == [*range(25, 65)]
    restarts = frames.rejects.filter(pc.field("reason") == "restarted_counter")
    assert restarts["count"].to_pylist() == [25, 30]
    assert (array(restarts, "time") // DAY_NS).tolist() == [day, day + 1]


def test_a_single_repeated_number_is_one_reject(tmp_path):
    a = write(tmp_path / "a.mcap", "s", [(0, 0), (1, 1), (2, 1), (3, 3)])
    log = read(a)
    assert array(log.exposures, "frame_number").tolist() == [0, 1, 3]
    assert rows(log) == [("duplicate_number", "s", "a.mcap", 1)]


def test_the_same_log_under_two_names_is_read_once(tmp_path):
    a = write(tmp_path / "a.mcap", "s", [(0, 0)])
    b = write(tmp_path / "b.mcap", "s", [(0, 0)])
    log = read(b, a)
    assert [source.name for source in log.sources] == ["a.mcap"]
    assert log.exposures.num_rows == 1
    assert log.rejects.num_rows == 0


def test_a_sensor_without_calibration_keeps_its_frames(tmp_path):
    log = read(write(tmp_path / "a.mcap", "s", [(0, 0)]))
    assert log.exposures.num_rows == 1
    assert log.cameras.num_rows == 0


def test_calibrations_are_sorted_and_one_that_repeats_the_one_before_counts_once(tmp_path):
    times = [START_NS + 5, START_NS, START_NS]
    log = read(write(tmp_path / "a.mcap", "s", [(0, 0)], camera_ns=times))
    assert array(log.cameras, "time").tolist() == [START_NS]


def test_a_calibration_that_comes_back_counts_again(tmp_path):
    path = write(tmp_path / "a.mcap", "s", [(0, 0)])
    with LogWriter(tmp_path / "b.mcap") as log:
        for k, fx_px in enumerate([500.0, 500.0, 510.0, 510.0, 500.0]):
            log.camera("s", START_NS + k, CAMERA | {"fx_px": fx_px})
            log.camera("r", START_NS + k, CAMERA)
    found = read(path, tmp_path / "b.mcap").cameras
    assert array(found, "sensor_id").tolist() == ["r", "s", "s", "s"]
    assert (array(found, "time") - START_NS).tolist() == [0, 0, 2, 4]
    assert array(found, "fx_px").tolist() == [500.0, 500.0, 510.0, 500.0]


def resident_mib(of):
    """The resident memory of this process: `VmRSS` now, `VmHWM` at most so far."""
    return int(Path("/proc/self/status").read_text().split(f"{of}:")[1].split()[0]) / 1024


@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux for the memory")
def test_calibrations_with_each_frame_do_not_add_up_in_memory(tmp_path):
    folder, n = ReadFolder(tmp_path), 20_000
    sensors = np.repeat(["r", "s"], n // 2)
    columns = {name: np.zeros(n, int if name == "width" else float) for name in CAMERAS.names}
    columns |= {"sensor_id": sensors, "height": np.zeros(n, int), "fisheye": np.zeros(n, bool)}
    empty = {name: schema.empty_table() for name, schema in LOG_PIECE.items()}
    for k in range(20):  # altogether 200 MB
        columns["time"] = START_NS + k * n + np.arange(n)
        write_part(folder.piece(0, k), LOG_PIECE, empty | {"cameras": table(CAMERAS, columns)})
    log = ReadLog(0, 20, LogSource("a.mcap", 1, "", None, None), {}, 20 * n)
    before = resident_mib("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak so far is forgotten
    found = ordered_logs(OrderPlan(folder, [log], []), [], Settings().sensors).cameras
    assert resident_mib("VmHWM") - before < 100
    assert found["sensor_id"].to_pylist() == ["r", "s"]
    assert (array(found, "time") - START_NS).tolist() == [0, n // 2]


def test_states_are_converted_to_gcrf(tmp_path):
    log = read(write(tmp_path / "a.mcap", "s", [(0, 0)], states=[0], frame="ITRF", sigma_km=0.2))
    r_km = stack(log.states, "{}_km")
    assert np.linalg.norm(r_km) == pytest.approx(7000.0, abs=1e-9)
    assert abs(r_km[0, 0] - 7000.0) > 1000  # Earth has turned
    assert array(log.states, "position_sigma_km").tolist() == [0.2]


@pytest.mark.filterwarnings("ignore:.*dubious year")  # ERFA on leap seconds not yet announced
def test_outside_the_earth_orientation_table_sigmas_are_larger_with_a_warning(tmp_path, caplog):
    far_s = 30 * 365 * 86400  # 2049
    path = write(tmp_path / "a.mcap", "s", [(far_s, 0)], states=[far_s], frame="ITRF")
    with caplog.at_level(logging.WARNING):
        log = read(path)
    sigma_km = array(log.states, "position_sigma_km")[0]
    assert sigma_km > Settings().sensors.position_sigma_km
    assert "outside the Earth-orientation table" in caplog.text


@pytest.mark.skipif(not LOGS.exists(), reason="the sample logs are not at hand")
@pytest.mark.parametrize(
    ("name", "n_frames", "n_states"),
    [
        ("four_sensors_2deg", 240, 260),
        ("six_sensors_8deg_no_prior", 180, 210),
        ("lost_in_space_20deg", 100, 105),
    ],
)
def test_the_sample_logs_are_whole(name, n_frames, n_states):
    log = read(LOGS / f"{name}.mcap")
    assert (log.exposures.num_rows, log.states.num_rows) == (n_frames, n_states)
    assert log.rejects.num_rows == 0

"""Logs in: what is read, what is left out and why, and what is an error."""

import json
import random

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer

from epipole.io.logs.left_out import ROWS_ALIKE
from epipole.io.logs.logged_times import read_log_times
from epipole.io.logs.mcap import records as log_records
from epipole.io.logs.messages import frames as frame_columns
from epipole.io.logs.messages import json_text, protobuf
from epipole.io.logs.messages.registry import kinds_of_schemas
from epipole.io.logs.reader import read_log
from epipole.io.logs.writer import LogWriter, calibration_values
from epipole.schemas.bridge import array, flatten, stack
from epipole.schemas.errors import LogError
from epipole.schemas.log_messages import (
    CALIBRATION,
    CALIBRATION_NAME,
    CENTROID_FRAME,
    FRAME,
    SENSOR_STATE,
    STATE,
)

START_NS = 1_554_091_200_000_000_000
SECOND_NS = 1_000_000_000
CAMERA = {
    "width": 512,
    "height": 480,
    "fx_px": 1000.5,
    "fy_px": 1001.25,
    "cx_px": 255.5,
    "cy_px": 239.5,
    "k1": -0.05,
    "k2": 0.01,
    "p1": 1e-4,
    "p2": -1e-4,
    "k3": 0.001,
}
N_FRAMES = 30
ENCODINGS = ("protobuf", "json", "ros2")
COMPRESSIONS = ("zstd", "lz4", "none")


def write(path, n=N_FRAMES, **options):
    """Write a log of one sensor: a frame and a state per second."""
    rng = np.random.default_rng(0)
    with LogWriter(path, **options) as log:
        log.camera("sat1", START_NS, CAMERA)
        for i in range(n):
            time_ns = START_NS + i * SECOND_NS
            x = rng.uniform(0, 500, i % 7).astype(np.float32)
            log.state("sat1", time_ns, position_km=[7000.0, i, 2.0], velocity_km_s=[0.0, 7.5, 1.0])
            log.frame(
                "sat1",
                time_ns + 7,
                frame_number=i,
                exposure_s=0.2,
                x_px=x,
                y_px=x + 1,
                flux=x + 2 if i % 2 else None,
                sigma_px=np.full(len(x), 0.125),
            )
    return path


def frame(**changes):
    """Return the bytes of a good frame of three centroids, but for the changes."""
    values = {
        "timestamp": START_NS,
        "sensor_id": "sat1",
        "frame_number": 1,
        "exposure_s": 0.1,
        "x_px": [1.0, 2.0, 3.0],
        "y_px": [4.0, 5.0, 6.0],
        "flux": None,
        "sigma_px": None,
    }
    return protobuf.encode(FRAME, {**values, **changes})


def state(**changes):
    values = {
        "timestamp": START_NS,
        "sensor_id": "sat1",
        "frame": "GCRF",
        "position_km": [7000.0, 0.0, 0.0],
        "velocity_km_s": None,
        "position_sigma_km": 0.0,
        "attitude_xyzw": None,
        "attitude_sigma_arcsec": 0.0,
    }
    return protobuf.encode(STATE, {**values, **changes})


def json_calibration():
    """Return the values of a good calibration in JSON."""
    values = calibration_values("sat1", START_NS, CAMERA)
    return json.loads(json_text.encode(CALIBRATION, values))


def write_raw(path, *recorded, encoding="protobuf", schema_encoding="protobuf"):
    """Write messages as bytes: (schema name, data), all with the same log time."""
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channels = {}
        for name, data in recorded:
            if name not in channels:
                schema = writer.register_schema(name, schema_encoding, b"")
                channels[name] = writer.register_channel("/any/topic", encoding, schema)
            writer.add_message(channels[name], START_NS, data, START_NS)
        writer.finish()
    return path


def read_with_good_frame(tmp_path, *recorded):
    """Return the log of these messages and one good frame of another sensor."""
    good = (CENTROID_FRAME.name, frame(sensor_id="good"))
    return read_log(write_raw(tmp_path / "a.mcap", good, *recorded))


def reasons(contents):
    return [
        (row["reason"], row["sensor_id"], row["count"])
        for row in contents.rejects.drop_columns("time").to_pylist()
    ]


# What is read


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_what_is_written_is_read(tmp_path, encoding, compression):
    path = write(tmp_path / "a.mcap", encoding=encoding, compression=compression)
    contents = read_log(path)
    assert array(contents.exposures, "frame_number").tolist() == list(range(N_FRAMES))
    expected_ns = START_NS + 7 + np.arange(N_FRAMES) * SECOND_NS
    np.testing.assert_array_equal(array(contents.exposures, "time"), expected_ns)
    x, offsets = flatten(contents.exposures, "x_px")
    y, _ = flatten(contents.exposures, "y_px")
    assert np.diff(offsets).tolist() == [i % 7 for i in range(N_FRAMES)]
    rng = np.random.default_rng(0)
    expected = np.concatenate([rng.uniform(0, 500, i % 7) for i in range(N_FRAMES)])
    np.testing.assert_array_equal(x, expected.astype(np.float32))
    np.testing.assert_array_equal(y, expected.astype(np.float32) + np.float32(1))
    given = [i for i in range(N_FRAMES) if contents.exposures["flux"][i].is_valid]
    assert given == [i for i in range(N_FRAMES) if i % 2 and i % 7]
    np.testing.assert_array_equal(stack(contents.states, "{}_km")[:, 1], np.arange(N_FRAMES))
    np.testing.assert_array_equal(stack(contents.states, "v{}_km_s")[3], [0.0, 7.5, 1.0])
    assert np.isnan(array(contents.states, "qx")).all()
    camera = {name: contents.cameras[name][0].as_py() for name in CAMERA}
    assert camera == CAMERA
    assert contents.rejects.num_rows == 0
    assert contents.source.size == path.stat().st_size
    assert contents.source.first_time_ns == START_NS + 7


def test_frames_that_come_in_batches_are_one_table(tmp_path, monkeypatch):
    whole = read_log(write(tmp_path / "a.mcap"))
    monkeypatch.setattr(frame_columns, "BATCH", 7)
    assert read_log(tmp_path / "a.mcap").exposures.equals(whole.exposures)


def test_a_url_is_read_like_a_file(tmp_path):
    fsspec = pytest.importorskip("fsspec")
    path = write(tmp_path / "a.mcap")
    with fsspec.open("memory://logs/a.mcap", "wb") as file:
        file.write(path.read_bytes())
    assert read_log("memory://logs/a.mcap").exposures.equals(read_log(path).exposures)
    with pytest.raises(LogError, match=r"none\.mcap: no such file"):
        read_log("memory://logs/none.mcap")
    with pytest.raises(LogError, match="is a folder"):
        read_log("memory://logs")
    with pytest.raises(LogError, match="cannot be read"):
        read_log("carrier-pigeon://logs/a.mcap")


def test_encodings_may_be_mixed_and_other_messages_are_ignored(tmp_path):
    text = json.dumps(
        {"timestamp": "2019-04-01T04:00:01.5Z", "sensorId": "b", "frameNumber": "7", "xPx": [1]}
        | {"y_px": ["NaN"], "exposure_s": 1}
    )
    good = json.dumps(
        {"timestamp": {"sec": 1_554_091_200, "nsec": 5}, "sensor_id": "c", "x_px": [1.1]}
        | {"y_px": [2], "frame_number": 3, "exposure_s": 0}
    )
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file, compression=CompressionType.LZ4)
        writer.start()
        schema = writer.register_schema(CENTROID_FRAME.name, "jsonschema", b"")
        as_json = writer.register_channel("/1", "json", schema)
        schema = writer.register_schema(CENTROID_FRAME.name, "protobuf", b"")
        as_protobuf = writer.register_channel("/2", "protobuf", schema)
        other = writer.register_channel("/3", "ros1", writer.register_schema("a/B", "ros1msg", b""))
        none = writer.register_channel("/4", "what", 0)
        for channel, data in (
            (as_json, text.encode()),
            (as_json, good.encode()),
            (as_protobuf, frame()),
            (other, b"?"),
            (none, b"?"),
        ):
            writer.add_message(channel, START_NS, data, START_NS)
        writer.finish()
    contents = read_log(tmp_path / "a.mcap")
    assert contents.exposures["sensor_id"].to_pylist() == ["c", "sat1"]
    # A text has more digits than the message type: a float of 32 bits.
    assert flatten(contents.exposures, "x_px")[0].tolist() == [
        float(np.float32(1.1)),
        1.0,
        2.0,
        3.0,
    ]
    assert reasons(contents) == [("nan", "b", 1)]
    assert array(contents.rejects, "time").tolist() == [START_NS + 1_500_000_000]


def test_ros_names_with_and_without_msg_are_the_same():
    kinds = kinds_of_schemas()
    assert kinds["epipole_msgs/CentroidFrame"] == FRAME
    assert kinds["epipole_msgs/msg/CentroidFrame"] == FRAME


def test_invalid_flux_is_nan_and_the_frame_stays(tmp_path):
    flux = [-1.0, 0.0, 5.0]
    contents = read_log(write_raw(tmp_path / "a.mcap", (CENTROID_FRAME.name, frame(flux=flux))))
    np.testing.assert_array_equal(flatten(contents.exposures, "flux")[0], [np.nan, np.nan, 5.0])
    assert contents.rejects.num_rows == 0


# What is left out


@pytest.mark.parametrize(
    ("changes", "reason", "sensor_id"),
    [
        ({"x_px": [1.0, np.nan, 3.0]}, "nan", "sat1"),
        ({"y_px": [1.0, np.inf, 3.0]}, "nan", "sat1"),
        ({"x_px": [1.0]}, "unequal_arrays", "sat1"),
        ({"flux": [1.0, 2.0]}, "unequal_arrays", "sat1"),
        ({"sigma_px": [0.1]}, "unequal_arrays", "sat1"),
        ({"sigma_px": [0.1, 0.0, 0.1]}, "bad_sigma", "sat1"),
        ({"sigma_px": [0.1, -0.1, 0.1]}, "bad_sigma", "sat1"),
        ({"sigma_px": [0.1, np.nan, 0.1]}, "bad_sigma", "sat1"),
        ({"sigma_px": [0.1, 1e30, 0.1]}, "bad_sigma", "sat1"),
        ({"sigma_px": [0.1, 1e-30, 0.1]}, "bad_sigma", "sat1"),
        ({"x_px": [1.0, 1e30, 3.0]}, "bad_centroid", "sat1"),
        ({"y_px": [1.0, -2e6, 3.0]}, "bad_centroid", "sat1"),
        ({"sensor_id": "../x"}, "bad_sensor_id", None),
        ({"sensor_id": ""}, "bad_sensor_id", None),
        ({"sensor_id": "a" * 64}, "bad_sensor_id", None),
        ({"sensor_id": "sat1\n"}, "bad_sensor_id", None),
        ({"timestamp": 0}, "no_timestamp", "sat1"),
        ({"timestamp": 86_400 * SECOND_NS}, "no_timestamp", "sat1"),
        ({"timestamp": (1 << 32) * SECOND_NS}, "no_timestamp", "sat1"),
        ({"frame_number": 1 << 63}, "bad_frame_number", "sat1"),
    ],
)
def test_a_bad_frame_is_a_row_and_the_rest_goes_on(tmp_path, changes, reason, sensor_id):
    contents = read_with_good_frame(tmp_path, (CENTROID_FRAME.name, frame(**changes)))
    assert contents.exposures["sensor_id"].to_pylist() == ["good"]
    assert reasons(contents) == [(reason, sensor_id, 1)]
    assert contents.rejects["source"].to_pylist() == ["a.mcap"]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"frame": "J2000"}, "unknown_frame"),
        ({"position_km": [1.0, 2.0]}, "bad_position"),
        ({"position_km": None}, "bad_position"),
        ({"position_km": [np.nan, 7000.0, 0.0]}, "bad_position"),
        ({"position_km": [7.0e6, 1.0e8, 0.0]}, "bad_position"),
        ({"position_km": [100.0, 200.0, 300.0]}, "inside_earth"),
        ({"velocity_km_s": [1.0, 2.0]}, "bad_velocity"),
        ({"velocity_km_s": [1.0, 2.0, np.inf]}, "bad_velocity"),
        ({"velocity_km_s": [299_792.5, 0.0, 0.0]}, "bad_velocity"),
        ({"velocity_km_s": [7_500.0, 0.0, 0.0]}, "bad_velocity"),
        ({"position_sigma_km": 1e300}, "bad_position_sigma"),
        ({"position_sigma_km": np.inf}, "bad_position_sigma"),
        ({"timestamp": 5}, "no_timestamp"),
        ({"sensor_id": "/etc"}, "bad_sensor_id"),
    ],
)
def test_a_bad_state_is_a_row(tmp_path, changes, reason):
    contents = read_with_good_frame(tmp_path, (SENSOR_STATE.name, state(**changes)))
    assert contents.states.num_rows == 0
    assert [row[0] for row in reasons(contents)] == [reason]


def test_a_quaternion_near_unit_length_is_scaled_to_it(tmp_path):
    q = [0.0, 0.0, 0.6006, 0.8008]
    contents = read_with_good_frame(tmp_path, (SENSOR_STATE.name, state(attitude_xyzw=q)))
    np.testing.assert_allclose(
        stack(contents.states, "q{}", "xyzw"), [[0, 0, 0.6, 0.8]], atol=1e-15
    )


@pytest.mark.parametrize("q", [[0.0, 0.0, 0.0, 0.0], [1.0, 1.0, 0.0, 0.0], [1.0], [np.nan] * 4])
def test_a_bad_attitude_is_left_out_and_its_position_stays(tmp_path, q):
    contents = read_with_good_frame(tmp_path, (SENSOR_STATE.name, state(attitude_xyzw=q)))
    assert contents.states.num_rows == 1
    assert np.isnan(stack(contents.states, "q{}", "xyzw")).all()
    assert reasons(contents) == [("bad_attitude", "sat1", 1)]


@pytest.mark.parametrize(
    ("degrees", "left_out"),
    [(2, []), (10, [("vague_attitude", "sat1", 1)]), (180, []), (np.inf, [])],
)
def test_an_attitude_that_may_be_any_is_none(tmp_path, degrees, left_out):
    told = state(attitude_xyzw=[0.0, 0.6, 0.0, 0.8], attitude_sigma_arcsec=degrees * 3600.0)
    contents = read_with_good_frame(tmp_path, (SENSOR_STATE.name, told))
    assert contents.states.num_rows == 1
    assert np.isnan(stack(contents.states, "q{}", "xyzw")).all() == (degrees > 2)
    assert reasons(contents) == left_out


@pytest.mark.parametrize("exposure_s", [-1.0, np.nan, np.inf, 1e9])
def test_an_exposure_time_out_of_bounds_is_unknown_and_the_frame_stays(tmp_path, exposure_s):
    bad = (CENTROID_FRAME.name, frame(exposure_s=exposure_s))
    contents = read_log(write_raw(tmp_path / "a.mcap", bad))
    assert array(contents.exposures, "exposure_s").tolist() == [0.0]
    assert reasons(contents) == [("bad_exposure", "sat1", 1)]


@pytest.mark.parametrize("sigma", [-1.0, np.nan, 0.0])
def test_an_invalid_sigma_is_unknown(tmp_path, sigma):
    contents = read_with_good_frame(tmp_path, (SENSOR_STATE.name, state(position_sigma_km=sigma)))
    assert array(contents.states, "position_sigma_km").tolist() == [0.0]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"width": 0}, "bad_image_size"),
        ({"fx_px": 0.0}, "bad_camera_matrix"),
        ({"cx_px": np.nan}, "bad_camera_matrix"),
        ({"k1": np.inf}, "bad_distortion"),
        ({"width": 1_000_000_000, "height": 1_000_000_000}, "bad_image_size"),
        ({"fx_px": 1e300}, "bad_camera_matrix"),
        ({"fx_px": 1e-300, "fy_px": 1e-300}, "bad_camera_matrix"),
        ({"fy_px": -1e300}, "bad_camera_matrix"),
        ({"fx_px": 100.0, "fy_px": 100.0}, "bad_camera_matrix"),  # corner at 73 degrees
        ({"cx_px": 1e9}, "bad_camera_matrix"),
        ({"k1": 1e300}, "bad_distortion"),
        ({"k3": -1e300}, "bad_distortion"),
        ({"p1": 5.0}, "bad_distortion"),
        ({"k1": -5.0}, "folded_image"),  # folds at 0.26 of 0.35
        ({"p2": -0.9}, "folded_image"),
        ({"line_time_s": 0.1}, "bad_line_time"),
        ({"line_time_s": np.nan}, "bad_line_time"),
        ({"fx_px": 426.0, "fy_px": 426.0, "k1": -0.5, "k2": 0.0, "k3": 0.0}, "folded_image"),
    ],
)
def test_an_unusable_calibration_is_a_row(tmp_path, changes, reason):
    data = protobuf.encode(CALIBRATION, calibration_values("sat1", START_NS, CAMERA | changes))
    contents = read_with_good_frame(tmp_path, (CALIBRATION_NAME, data))
    assert contents.cameras.num_rows == 0
    assert reasons(contents) == [(reason, "sat1", 1)]


@pytest.mark.parametrize(
    "optics",
    [
        {"k1": -0.9, "k2": 0.0, "k3": 0.0},
        {"k1": 0.9},
        {"k1": -2.0, "k2": 6.0},
        {},
        # 62 degrees along the sides: it folds between these and the corners.
        {"fx_px": 426.0, "fy_px": 426.0, "k1": -0.3, "k2": 0.0, "k3": 0.0},
    ],
)
def test_a_distortion_that_folds_beyond_the_image_is_valid(tmp_path, optics):
    data = protobuf.encode(CALIBRATION, calibration_values("sat1", START_NS, CAMERA | optics))
    contents = read_with_good_frame(tmp_path, (CALIBRATION_NAME, data))
    assert contents.cameras.num_rows == 1


@pytest.mark.parametrize("size", [1 << 31, 1 << 63, 1 << 64, 10**400])
def test_an_image_of_any_size_in_json_is_no_error(tmp_path, size):
    values = json_calibration() | {"width": size}
    good = json.dumps({"timestamp": "2019-04-01T04:00:00Z", "sensor_id": "a"}).encode()
    recorded = [(CENTROID_FRAME.name, good), (CALIBRATION_NAME, json.dumps(values).encode())]
    contents = read_log(write_raw(tmp_path / "a.mcap", *recorded, encoding="json"))
    assert contents.cameras.num_rows == 0
    assert len(reasons(contents)) == 1


def test_a_calibration_of_rows_that_count_upward_is_valid(tmp_path):
    values = calibration_values("sat1", START_NS, CAMERA | {"fy_px": -CAMERA["fy_px"]})
    contents = read_with_good_frame(
        tmp_path, (CALIBRATION_NAME, protobuf.encode(CALIBRATION, values))
    )
    assert array(contents.cameras, "fy_px").tolist() == [-CAMERA["fy_px"]]
    assert reasons(contents) == []


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"distortion_model": "rational_polynomial"}, "unknown_distortion_model"),
        ({"D": [0.1, 0.2, 0.3]}, "bad_distortion"),
        ({"distortion_model": "equidistant", "D": [0.0] * 5}, "bad_distortion"),
        ({"distortion_model": "fisheye", "D": [0.0, 0.0, 0.0, 2e4]}, "bad_distortion"),
        ({"K": [0.0] * 9}, "bad_camera_matrix"),
        ({"K": [1.0] * 8}, "bad_camera_matrix"),
        ({"K": [9.0, 0.5, 1.0, 0.0, 9.0, 1.0, 0.0, 0.0, 1.0]}, "bad_camera_matrix"),
    ],
)
def test_a_calibration_of_another_model_is_a_row(tmp_path, changes, reason):
    values = json_calibration() | changes
    contents = read_log(
        write_raw(
            tmp_path / "a.mcap",
            (
                CENTROID_FRAME.name,
                json.dumps({"timestamp": "2019-04-01T04:00:00Z", "sensor_id": "a"}).encode(),
            ),
            (CALIBRATION_NAME, json.dumps(values).encode()),
            encoding="json",
        )
    )
    assert [row[0] for row in reasons(contents)] == [reason]


@pytest.mark.parametrize(
    ("model", "terms"),
    [
        ("", {"k1": -0.05, "p2": -1e-4, "k3": 0.0, "k4": 0.0, "fisheye": False}),
        ("equidistant", {"k1": -0.05, "k3": 1e-4, "k4": -1e-4, "p1": 0.0, "fisheye": True}),
        ("kannala_brandt", {"k3": 1e-4, "p2": 0.0, "fisheye": True}),
    ],
)
def test_the_meaning_of_four_terms_is_that_of_the_distortion_model(tmp_path, model, terms):
    values = json_calibration()
    values["D"], values["distortion_model"] = values["D"][:4], model
    good = json.dumps({"timestamp": "2019-04-01T04:00:00Z", "sensor_id": "a"}).encode()
    path = write_raw(
        tmp_path / "a.mcap",
        (CENTROID_FRAME.name, good),
        (CALIBRATION_NAME, json.dumps(values).encode()),
        encoding="json",
    )
    camera = read_log(path).cameras
    assert {name: camera[name][0].as_py() for name in terms} == terms


@pytest.mark.parametrize("data", [b"\xff\xff\xff", b"\x2a\x03abc", frame()[:-1]])
def test_an_undecodable_message_is_a_row(tmp_path, data):
    contents = read_with_good_frame(tmp_path, (CENTROID_FRAME.name, data))
    assert reasons(contents) == [("undecodable_frame", None, 1)]


def test_many_bad_messages_alike_are_few_rows_that_count_them_all(tmp_path):
    good = (CENTROID_FRAME.name, frame(sensor_id="good"))
    path = write_raw(tmp_path / "a.mcap", good, *[(CENTROID_FRAME.name, b"\1")] * 5000)
    contents = read_log(path)
    assert contents.rejects.num_rows == ROWS_ALIKE
    assert sum(contents.rejects["count"].to_pylist()) == 5000


# What is an error


def line_of(path):
    with pytest.raises(LogError) as caught:
        read_log(path)
    line = str(caught.value)
    assert "\n" not in line
    assert str(path) in line
    return line


def test_a_missing_file_is_an_error(tmp_path):
    assert "no such file" in line_of(tmp_path / "none.mcap")


def test_a_folder_is_an_error(tmp_path):
    assert "folder" in line_of(tmp_path)


@pytest.mark.parametrize("data", [b"", b"\x89PNG\r\n\x1a\n" + bytes(100), b"\x89MCAP"])
def test_a_file_that_is_no_mcap_is_an_error(tmp_path, data):
    (tmp_path / "a.mcap").write_bytes(data)
    assert "not an MCAP file" in line_of(tmp_path / "a.mcap")


# What has no frames, or frames at other times


def test_a_log_without_frames_is_read(tmp_path):
    with LogWriter(tmp_path / "a.mcap"):
        pass
    contents = read_log(tmp_path / "a.mcap")
    assert (contents.source.first_time_ns, contents.rejects.num_rows) == (None, 0)
    contents = read_log(write_raw(tmp_path / "b.mcap", (SENSOR_STATE.name, state())))
    assert contents.source.first_time_ns == contents.source.last_time_ns == START_NS
    assert contents.states.num_rows == 1


def test_a_log_that_is_cut_before_its_first_frame_is_read(tmp_path):
    whole = write(tmp_path / "a.mcap").read_bytes()
    (tmp_path / "a.mcap").write_bytes(whole[:200])
    contents = read_log(tmp_path / "a.mcap")
    assert contents.exposures.num_rows == 0
    assert reasons(contents) == [("truncated", None, 1)]


def test_a_log_of_bad_frames_alone_has_their_rows(tmp_path):
    path = write_raw(tmp_path / "a.mcap", (CENTROID_FRAME.name, frame(x_px=[np.nan] * 3)))
    assert reasons(read_log(path)) == [("nan", "sat1", 1)]


def test_a_channel_of_unknown_encoding_costs_its_messages_only(tmp_path, caplog):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(CENTROID_FRAME.name, "protobuf", b"")
        bad, good = (
            writer.register_channel(f"/{encoding}", encoding, schema)
            for encoding in ("protofub", "protobuf")
        )
        for _ in range(3):
            writer.add_message(bad, START_NS, frame(), START_NS)
        writer.add_message(good, START_NS, frame(sensor_id="good"), START_NS)
        writer.finish()
    contents = read_log(tmp_path / "a.mcap")
    assert contents.exposures["sensor_id"].to_pylist() == ["good"]
    assert reasons(contents) == [("unknown_encoding", None, 3)]
    assert "topic /protofub: messages are encoded as 'protofub'" in caplog.text


def test_a_channel_of_unknown_encoding_is_named_in_one_line(tmp_path, caplog):
    """Its names come from the log: they could hold commands to the terminal, or a megabyte."""
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(CENTROID_FRAME.name, "protobuf", b"")
        channel = writer.register_channel("/a\x1b[31m\n", "x" * 1000, schema)
        writer.add_message(channel, START_NS, frame(), START_NS)
        writer.finish()
    read_log(tmp_path / "a.mcap")
    (message,) = caplog.messages
    assert r"topic /a\x1b[31m\n: " in message
    assert message.isprintable()
    assert len(message) < len(str(tmp_path)) + 400


def test_frames_with_a_stray_clock_are_left_out(tmp_path):
    day = 86_400 * SECOND_NS
    times = [START_NS + i * SECOND_NS for i in range(5)]
    times += [START_NS + 3 * day, 1_000_000_000 * SECOND_NS, START_NS + 40 * day]
    recorded = [
        (CENTROID_FRAME.name, frame(timestamp=t, frame_number=i)) for i, t in enumerate(times)
    ]
    contents = read_log(write_raw(tmp_path / "a.mcap", *recorded))
    assert array(contents.exposures, "time").tolist() == times[:5]
    assert reasons(contents) == [("stray_time", "sat1", 3)]
    assert (contents.source.first_time_ns, contents.source.last_time_ns) == (times[0], times[4])


def test_of_two_frames_far_apart_the_later_counts(tmp_path):
    recorded = [
        (CENTROID_FRAME.name, frame(timestamp=t)) for t in (START_NS, 1_000_000_000 * SECOND_NS)
    ]
    contents = read_log(write_raw(tmp_path / "a.mcap", *recorded))
    assert array(contents.exposures, "time").tolist() == [START_NS]


# Damage anywhere


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_no_damage_stops_the_reading_or_stays_unreported(tmp_path, encoding, compression):
    path = tmp_path / "a.mcap"
    whole = write(path, encoding=encoding, compression=compression, chunk_size=1000).read_bytes()
    rng = random.Random(encoding + compression)
    for _ in range(60):
        data = bytearray(whole)
        if rng.random() < 0.4:
            del data[rng.randrange(8, len(data)) :]
        for _ in range(rng.choice((0, 1, 1, 20))):
            data[rng.randrange(8, len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        try:
            contents = read_log(path)
        except LogError:
            continue
        assert contents.exposures.num_rows == N_FRAMES or contents.rejects.num_rows > 0
        assert contents.states.num_rows == N_FRAMES or contents.rejects.num_rows > 0


def test_the_times_of_a_log_are_known_without_reading_it(tmp_path, monkeypatch):
    path = write(tmp_path / "a.mcap")
    monkeypatch.setattr(log_records, "open_chunk", None)  # no chunk is opened
    assert read_log_times(path) == (START_NS, START_NS + 7 + (N_FRAMES - 1) * SECOND_NS)
    path.write_bytes(path.read_bytes()[:-1])  # never closed: its chunks tell
    assert read_log_times(path) == (START_NS, START_NS + 7 + (N_FRAMES - 1) * SECOND_NS)
    path.write_bytes(path.read_bytes()[:20])
    assert read_log_times(path) is None
    (tmp_path / "b.mcap").write_bytes(b"no log")
    with pytest.raises(LogError, match="not an MCAP file"):
        read_log_times(tmp_path / "b.mcap")

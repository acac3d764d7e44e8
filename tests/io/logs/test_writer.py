"""Logs that are written here, read with public libraries."""

import errno
import io
import json

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import Writer

from epipole.io.logs.writer import LogWriter

START_NS = 1_554_091_200_000_000_000
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
X = np.array([1.5, 2.25, 300.125])


def write(path, **options):
    with LogWriter(path, **options) as log:
        log.camera("sat1", START_NS, CAMERA)
        log.state(
            "sat1",
            START_NS + 1,
            frame="TEME",
            position_km=[7000.0, 1.0, -2.0],
            velocity_km_s=(0.0, 7.5, 0.1),
            position_sigma_km=0.02,
            attitude_xyzw=np.array([0.0, 0.6, 0.0, 0.8]),
            attitude_sigma_arcsec=12.0,
        )
        log.frame(
            "sat1", START_NS + 1_500_000_007, frame_number=41, exposure_s=0.2, x_px=X, y_px=2 * X
        )
        log.frame("sat2", START_NS - 5, frame_number=0, exposure_s=0.0, x_px=[], y_px=[], flux=[])
    return path


def decoded(path, factory):
    with path.open("rb") as file:
        messages = make_reader(file, validate_crcs=True, decoder_factories=[factory])
        found = list(messages.iter_decoded_messages(log_time_order=False))
    return [(schema.name, channel.topic, m, value) for schema, channel, m, value in found]


TOPICS = ["/sat1/calibration", "/sat1/state", "/sat1/centroids", "/sat2/centroids"]


@pytest.mark.parametrize("compression", ["zstd", "lz4", "none"])
def test_protobuf_is_read_by_the_mcap_protobuf_library(tmp_path, compression):
    support = pytest.importorskip("mcap_protobuf.decoder")
    path = write(tmp_path / "a.mcap", compression=compression)
    found = decoded(path, support.DecoderFactory())
    assert [topic for _, topic, _, _ in found] == TOPICS
    camera, state, frame, empty = (value for *_, value in found)
    assert list(camera.D) == [-0.05, 0.01, 1e-4, -1e-4, 0.001]
    assert list(camera.K) == [1000.5, 0, 255.5, 0, 1001.25, 239.5, 0, 0, 1]
    assert (camera.frame_id, camera.width, camera.height) == ("sat1", 512, 480)
    assert (state.frame, list(state.velocity_km_s)) == ("TEME", [0.0, 7.5, 0.1])
    assert list(state.attitude_xyzw) == [0.0, 0.6, 0.0, 0.8]
    assert (frame.timestamp.seconds, frame.timestamp.nanos) == (1_554_091_201, 500_000_007)
    assert (frame.frame_number, list(frame.x_px), list(frame.y_px)) == (41, list(X), list(2 * X))
    assert list(frame.flux) == []
    assert (empty.timestamp.nanos, len(empty.x_px)) == (999_999_995, 0)
    assert [m.log_time for _, _, m, _ in found][2] == START_NS + 1_500_000_007


def test_cdr_is_read_by_the_mcap_ros2_library(tmp_path):
    support = pytest.importorskip("mcap_ros2.decoder")
    found = decoded(write(tmp_path / "a.mcap", encoding="ros2"), support.DecoderFactory())
    assert [name for name, *_ in found] == [
        "sensor_msgs/msg/CameraInfo",
        "epipole_msgs/msg/SensorState",
        "epipole_msgs/msg/CentroidFrame",
        "epipole_msgs/msg/CentroidFrame",
    ]
    camera, state, frame, empty = (value for *_, value in found)
    assert (camera.header.frame_id, camera.height, camera.width) == ("sat1", 480, 512)
    assert list(camera.d) == [-0.05, 0.01, 1e-4, -1e-4, 0.001]
    assert list(camera.k) == [1000.5, 0, 255.5, 0, 1001.25, 239.5, 0, 0, 1]
    assert (state.frame, state.attitude_sigma_arcsec) == ("TEME", 12.0)
    assert list(state.position_km) == [7000.0, 1.0, -2.0]
    assert (frame.timestamp.sec, frame.timestamp.nanosec) == (1_554_091_201, 500_000_007)
    assert (frame.frame_number, list(frame.y_px)) == (41, list(2 * X))
    assert list(empty.x_px) == []


def test_json_has_the_declared_names_and_times(tmp_path):
    path = write(tmp_path / "a.mcap", encoding="json")
    reader = make_reader(io.BytesIO(path.read_bytes()))
    found = [json.loads(m.data) for _, _, m in reader.iter_messages(log_time_order=False)]
    assert found[0]["frame_id"] == "sat1"
    assert found[1]["position_sigma_km"] == 0.02
    assert found[2]["timestamp"] == {"sec": 1_554_091_201, "nsec": 500_000_007}
    assert found[2]["x_px"] == list(X)


@pytest.mark.parametrize("encoding", ["protobuf", "json", "ros2"])
def test_the_same_messages_give_the_same_bytes(tmp_path, encoding):
    first = write(tmp_path / "a.mcap", encoding=encoding).read_bytes()
    assert first == write(tmp_path / "b.mcap", encoding=encoding).read_bytes()


def test_a_disk_that_is_full_at_the_end_leaves_no_file(tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(Writer, "finish", full)
    with pytest.raises(OSError, match="No space left"):
        write(tmp_path / "a.mcap")
    assert list(tmp_path.iterdir()) == []


def test_a_writer_that_fails_leaves_no_file(tmp_path):
    with pytest.raises(KeyError), LogWriter(tmp_path / "a.mcap") as log:
        log.camera("sat1", START_NS, {"width": 1})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("option", ["encoding", "compression"])
def test_an_unknown_option_is_refused_by_name(tmp_path, option):
    with pytest.raises(ValueError, match="brotli"):
        LogWriter(tmp_path / "a.mcap", **{option: "brotli"})


def test_a_log_is_not_there_before_it_is_whole(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        log.camera("sat1", START_NS, CAMERA)
        assert not (tmp_path / "a.mcap").exists()
    summary = make_reader(io.BytesIO((tmp_path / "a.mcap").read_bytes())).get_summary()
    assert summary.statistics.message_count == 1

"""A log read by a range of time: the same rows as of the whole, and only the chunks it takes."""

import struct

import numpy as np
import pytest
from mcap.writer import Writer

from epipole.io.logs.mcap import chunks as log_chunks
from epipole.io.logs.mcap import records as log_records
from epipole.io.logs.messages.encodings import protobuf
from epipole.io.logs.reader import MARGIN_NS, read_log, read_log_times
from epipole.io.logs.writer import LogWriter, calibration_values
from epipole.schemas.bridge import array
from epipole.schemas.errors import LogError
from epipole.schemas.messages import (
    CALIBRATION,
    CALIBRATION_NAME,
    CENTROID_FRAME,
    FRAME,
    SENSOR_STATE,
    STATE,
)

START_NS = 1_554_091_200_000_000_000
MINUTE_NS = 60_000_000_000
N = 120  # frames and states, one of each a minute
CAMERA = {
    "width": 512,
    "height": 480,
    **dict.fromkeys(("fx_px", "fy_px"), 1000.0),
    **dict.fromkeys(("cx_px", "cy_px"), 250.0),
    **dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0),
}
FROM, TO = START_NS + 50 * MINUTE_NS, START_NS + 60 * MINUTE_NS


def frame(i):
    values = {"timestamp": START_NS + i * MINUTE_NS, "sensor_id": "sat1", "frame_number": i}
    values |= {"exposure_s": 0.1, "x_px": [1.0] * 20, "y_px": [2.0] * 20}
    return protobuf.encode(FRAME, values | {"flux": None, "sigma_px": None})


def state(i):
    values = {"timestamp": START_NS + i * MINUTE_NS, "sensor_id": "sat1", "frame": "GCRF"}
    values |= {"position_km": [7000.0, i, 0.0], "velocity_km_s": None, "position_sigma_km": 0.1}
    values |= {"attitude_xyzw": None, "attitude_sigma_arcsec": 0.0}
    return protobuf.encode(STATE, values)


def write(path, *, logged_ns=lambda i: START_NS + i * MINUTE_NS, cameras=(0,), **options):
    """Write a log of about five minutes a chunk, with a calibration at some of them."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=1500, **options)
        writer.start()
        channels = {}
        for name in (CENTROID_FRAME.name, SENSOR_STATE.name, CALIBRATION_NAME):
            schema = writer.register_schema(name, "protobuf", b"")
            channels[name] = writer.register_channel(f"/{name}", "protobuf", schema)
        for i in range(N):
            if i in cameras:
                values = calibration_values("sat1", START_NS + i * MINUTE_NS, CAMERA)
                data = protobuf.encode(CALIBRATION, values)
                writer.add_message(channels[CALIBRATION_NAME], logged_ns(i), data, 0)
            writer.add_message(channels[SENSOR_STATE.name], logged_ns(i), state(i), 0)
            writer.add_message(channels[CENTROID_FRAME.name], logged_ns(i), frame(i), 0)
        writer.finish()
    return path


@pytest.fixture
def opened(monkeypatch):
    """Return a list that gets the length of every chunk that is opened."""
    lengths = []

    def open_chunk(chunk):
        lengths.append(len(chunk))
        return log_chunks.open_chunk(chunk)

    monkeypatch.setattr(log_records, "open_chunk", open_chunk)
    return lengths


def numbers(contents):
    return array(contents.exposures, "frame_number").tolist()


def minutes(table):
    return ((array(table, "time") - START_NS) // MINUTE_NS).tolist()


def check(contents):
    """Hold what was read to the frames and states of the ten minutes.

    Their order is that of the file unless the log's times are wrong.
    """
    margin = MARGIN_NS // MINUTE_NS
    assert sorted(numbers(contents)) == list(range(50, 60))
    assert sorted(minutes(contents.states)) == list(range(50 - margin, 60 + margin))
    assert contents.rejects.num_rows == 0
    assert (contents.source.first_time_ns, contents.source.last_time_ns) == (FROM, TO - MINUTE_NS)


def test_a_range_opens_the_chunks_it_needs(tmp_path, opened):
    path = write(tmp_path / "a.mcap")
    whole = read_log(path)
    n_chunks = len(opened)
    opened.clear()
    contents = read_log(path, FROM, TO)
    check(contents)
    assert len(opened) < n_chunks / 2
    assert contents.exposures.equals(whole.exposures.slice(50, 10))
    assert contents.cameras.equals(whole.cameras)
    assert contents.source.sha256 == whole.source.sha256


def test_a_calibration_far_before_the_range_is_read(tmp_path):
    contents = read_log(write(tmp_path / "a.mcap", cameras=(0, 20, 100)), FROM, TO)
    assert minutes(contents.cameras) == [0, 20, 100]
    check(contents)


@pytest.mark.parametrize("limits", [(FROM, None), (None, FROM), (None, None)])
def test_either_end_may_be_open(tmp_path, limits):
    contents = read_log(write(tmp_path / "a.mcap"), *limits)
    first = 50 if limits[0] else 0
    assert numbers(contents) == list(range(first, 50 if limits[1] else N))


@pytest.mark.parametrize(
    "logged_ns",
    [
        lambda i: START_NS + 10**9 * i,  # played back sixty times as fast
        lambda i: 0,
        lambda i: START_NS + (N - i) * MINUTE_NS,
        lambda i: START_NS + i * MINUTE_NS + 30 * MINUTE_NS,
    ],
)
def test_a_log_that_was_logged_at_another_time_is_read_whole(tmp_path, logged_ns):
    check(read_log(write(tmp_path / "a.mcap", logged_ns=logged_ns), FROM, TO))


@pytest.mark.parametrize(
    "option",
    ["use_statistics", "use_summary_offsets", "repeat_channels", "repeat_schemas", "enable_crcs"],
)
def test_without_a_full_summary_the_same_is_read(tmp_path, option):
    contents = read_log(write(tmp_path / "a.mcap", cameras=(0, 20), **{option: False}), FROM, TO)
    check(contents)
    assert minutes(contents.cameras) == [0, 20]


def test_an_unclosed_log_is_read_whole(tmp_path, opened):
    path = write(tmp_path / "a.mcap")
    data = path.read_bytes()
    end = data.rfind(struct.pack("<BQ", 0x0F, 4))
    path.write_bytes(data[:end])
    contents = read_log(path, FROM, TO)
    assert numbers(contents) == list(range(50, 60))
    n_opened = len(opened)
    opened.clear()
    read_log(path)
    assert len(opened) == n_opened


def test_chunk_times_that_the_indexes_deny_are_not_trusted(tmp_path):
    path = write(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    at = 8
    while data[at] != 0x0F:  # every chunk says that it is of one nanosecond in 1970
        if data[at] == 0x06:
            struct.pack_into("<QQ", data, at + 9, 1, 1)
        at += 9 + struct.unpack_from("<Q", data, at + 1)[0]
    path.write_bytes(data)
    check(read_log(path, FROM, TO))


def test_messages_of_chunks_that_are_passed_over_are_not_missing(tmp_path):
    path = write(tmp_path / "a.mcap")
    assert read_log(path, FROM, TO).rejects.num_rows == 0


def test_damage_of_another_time_is_not_of_the_range(tmp_path):
    path = write(tmp_path / "a.mcap")
    data = bytearray(path.read_bytes())
    places, at = [], 8
    while data[at] != 0x0F:
        length = struct.unpack_from("<Q", data, at + 1)[0]
        if data[at] == 0x06:
            places.append((at, length))
        at += 9 + length
    for at, length in (places[3], places[len(places) // 2]):
        data[at + 9 + length - 10] ^= 0xFF
    path.write_bytes(data)
    whole, contents = read_log(path), read_log(path, FROM, TO)
    assert whole.rejects.num_rows == 2
    assert contents.rejects.num_rows == 1
    assert len(numbers(contents)) < 10


def test_a_range_without_frames_is_empty_and_no_error(tmp_path):
    far_ns = START_NS + 10**6 * MINUTE_NS
    contents = read_log(write(tmp_path / "a.mcap"), far_ns, far_ns + MINUTE_NS)
    assert (contents.exposures.num_rows, contents.states.num_rows) == (0, 0)
    assert contents.rejects.num_rows == 0


def test_the_times_of_a_log_are_known_without_reading_it(tmp_path, opened):
    path = write(tmp_path / "a.mcap")
    assert read_log_times(path) == (START_NS, START_NS + (N - 1) * MINUTE_NS)
    assert opened == []
    path.write_bytes(path.read_bytes()[:-1])
    assert read_log_times(path) is None
    (tmp_path / "b.mcap").write_bytes(b"no log")
    with pytest.raises(LogError, match="not an MCAP file"):
        read_log_times(tmp_path / "b.mcap")


def test_rows_of_a_range_do_not_depend_on_how_the_log_is_written(tmp_path):
    tables = []
    for compression, size in (("zstd", 700), ("lz4", 3000), ("none", 1 << 20)):
        path = tmp_path / f"{compression}.mcap"
        with LogWriter(path, compression=compression, chunk_size=size) as log:
            log.camera("sat1", START_NS, CAMERA)
            for i in range(N):
                x = np.full(3, i, np.float32)
                log.frame(
                    "sat1", START_NS + i * MINUTE_NS, frame_number=i, exposure_s=1, x_px=x, y_px=x
                )
        tables.append(read_log(path, FROM, TO).exposures.drop_columns(["source", "offset"]))
    assert tables[0].num_rows == 10
    assert tables[0].equals(tables[1])
    assert tables[0].equals(tables[2])

"""The compiled scans and the decoders give the same rows, bit for bit, and lose no message."""

import random
import struct

import numpy as np
import pytest
from mcap.writer import Writer

from epipole.io.logs.messages import frames as frame_columns
from epipole.io.logs.messages import protobuf, ros2_cdr
from epipole.io.logs.messages import states as state_columns
from epipole.io.logs.messages.batches import MAX_AT_ONCE
from epipole.io.logs.messages.protobuf import varint
from epipole.io.logs.messages.registry import encoding_named
from epipole.io.logs.messages.scan import MAX_NAMES
from epipole.io.logs.reader import read_log
from epipole.io.logs.writer import LogWriter
from epipole.schemas.bridge import array, flatten
from epipole.schemas.log_messages import FRAME, STATE

START_NS = 1_554_091_200_000_000_000
GOOD_FRAME = {
    "timestamp": START_NS,
    "sensor_id": "sat1",
    "frame_number": 1,
    "exposure_s": 0.1,
    "x_px": [1.0, 2.0, 3.0],
    "y_px": [4.0, 5.0, 6.0],
    "flux": [7.0, 8.0, 9.0],
    "sigma_px": [0.1, 0.2, 0.3],
}
GOOD_STATE = {
    "timestamp": START_NS,
    "sensor_id": "sat1",
    "frame": "GCRF",
    "position_km": [7000.0, 1.0, -2.0],
    "velocity_km_s": [0.1, 7.5, 1.0],
    "position_sigma_km": 0.05,
    "attitude_xyzw": [0.0, 0.6, 0.0, 0.8],
    "attitude_sigma_arcsec": 30.0,
}
# Reasons of rejects that are about one value: the rest of the message is used.
PARTLY_USED = ("bad_attitude", "vague_attitude", "bad_exposure")
NAN, INF = float("nan"), float("inf")
FRAME_CHANGES = [
    {},
    {"x_px": None, "y_px": None, "flux": None, "sigma_px": None},
    {"flux": None},
    {"sigma_px": None},
    {"x_px": [1.0], "y_px": [2.0], "flux": [3.0], "sigma_px": [1e-45]},
    *({"x_px": [1.0, bad, 2.0]} for bad in (NAN, INF, -INF, 3.4e38, -0.0)),
    *({"y_px": [bad, 1.0, 2.0]} for bad in (NAN, INF, -INF)),
    *({"sigma_px": [0.1, 0.1, bad]} for bad in (NAN, INF, 0.0, -0.0, -0.1)),
    *({"flux": [bad, 5.0, 6.0]} for bad in (NAN, INF, -INF, 0.0, -1.0)),
    *({name: [1.0, 2.0]} for name in ("x_px", "y_px", "flux", "sigma_px")),
    *({"exposure_s": bad} for bad in (NAN, INF, 0.0, -1.0, 5e-324)),
    *({"frame_number": n} for n in (0, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)),
    *({"timestamp": t} for t in (0, 1, (1 << 31) * 10**9 - 1, 10**9)),
    *({"x_px": [1.0, bad, 2.0]} for bad in (1e6, -1e6, 1.0001e6, -1.0001e6, 1e30)),
    *({"sigma_px": [0.1, 0.1, bad]} for bad in (1e-6, 0.9e-6, 1e4, 1.1e4)),
    *({"flux": [bad, 5.0, 6.0]} for bad in (1e-30, 0.9e-30, 1e30, 1.1e30)),
    *({"exposure_s": s} for s in (3600.0, 3601.0, -0.0, 1e300)),
    *({"timestamp": t} for t in (63_072_000 * 10**9 - 1, 63_072_000 * 10**9)),
    *({"sensor_id": i} for i in ("", "a" * 63, "a" * 64, "-a", "a-_9", "_", "a.b", "é", "../x")),
]
STATE_CHANGES = [
    {},
    {"velocity_km_s": None, "attitude_xyzw": None},
    *({"frame": name} for name in ("EME2000", "TEME", "ITRF", "", "J2000", "GCR", "GCRFF")),
    *({"position_km": r} for r in (None, [7000.0], [7000.0] * 4, [NAN, 7000.0, 0.0], [INF, 0, 0])),
    *({"position_km": [r, 0, 0]} for r in (6339.9, 6340.0, 6340.5, 6342, 9.95e6, 1e7, 1.1e7)),
    *({"velocity_km_s": v} for v in ([1.0], [NAN, 0, 0], [INF, 0, 0], [1e200] * 3, [1e308] * 3)),
    *({"velocity_km_s": [v, 0, 0]} for v in (980.0, 995.0, 1000.0, 1001.0, 3e5)),
    *({"position_sigma_km": s} for s in (1000.0, 1000.1, 1e300)),
    *({"attitude_sigma_arcsec": s} for s in (7200.0, 7200.1, 36e3, 648e3, 1e300)),
    *({"attitude_xyzw": None, "attitude_sigma_arcsec": s} for s in (36e3, 648e3)),
    *({"attitude_xyzw": q} for q in ([1.0], [0, 0, 0, 0], [NAN, 0, 0, 1], [0, 0, 0, 1.0101])),
    *({"attitude_xyzw": [0, 0, 0, n]} for n in (0.9899, 0.991, 1.0, 1.009, 1.0099, 1.02)),
    *({"position_sigma_km": s} for s in (0.0, NAN, INF, -1.0)),
    *({"attitude_sigma_arcsec": s} for s in (0.0, NAN, INF, -1.0)),
    *({"timestamp": t} for t in (0, 5)),
    *({"sensor_id": i} for i in ("", "b" * 64)),
]


def write_raw(path, recorded, encoding="protobuf", **options):
    """Write messages as bytes: (kind, data), a nanosecond apart."""
    of_log = encoding_named(encoding)
    with path.open("wb") as file:
        writer = Writer(file, **options)
        writer.start()
        channels = {}
        for i, (kind, data) in enumerate(recorded):
            if kind not in channels:
                name = of_log.schema_names[kind][0]
                schema = writer.register_schema(name, of_log.schema_encoding, b"")
                channels[kind] = writer.register_channel("/any", of_log.message_encoding, schema)
            writer.add_message(channels[kind], START_NS + i, data, START_NS + i)
        writer.finish()
    return path


def read_both_ways(path, monkeypatch):
    """Return a log as it is read normally, and as the decoders alone read it."""
    fast = read_log(path)
    with monkeypatch.context() as patch:
        patch.setattr(frame_columns, "scan_frames", lambda m, i, s, c, n: (i, n))
        patch.setattr(state_columns, "scan_states", lambda m, i, s, f, r, n: (i, n))
        return fast, read_log(path)


def check_same(path, monkeypatch, n_messages):
    """Check that both ways agree, and that no message is lost."""
    fast, slow = read_both_ways(path, monkeypatch)
    assert_same_exposures(fast.exposures, slow.exposures)
    assert fast.states.equals(slow.states)
    assert fast.cameras.equals(slow.cameras)
    order = [(name, "ascending") for name in fast.rejects.column_names]
    assert fast.rejects.sort_by(order).equals(slow.rejects.sort_by(order))
    used = np.isin(array(fast.rejects, "reason"), PARTLY_USED)
    lost = array(fast.rejects, "count")[~used]
    read = fast.exposures.num_rows + fast.states.num_rows + fast.cameras.num_rows
    assert read + lost.sum() == n_messages
    return fast


def assert_same_exposures(fast, slow):
    lists = ("x_px", "y_px", "flux", "sigma_px")
    assert fast.drop_columns(lists).equals(slow.drop_columns(lists))
    for name in lists:  # by their bits: NaN are alike, and 0 is not -0
        assert fast[name].is_valid().equals(slow[name].is_valid())
        (a, a_first), (b, b_first) = flatten(fast, name), flatten(slow, name)
        np.testing.assert_array_equal(a_first, b_first)
        np.testing.assert_array_equal(a.view(np.int64), b.view(np.int64))


def encoded(encoding):
    """Return every frame and state of the lists in one encoding, each followed by a good one."""
    encode, out = encoding_named(encoding).encode, []
    for change in FRAME_CHANGES:
        out.append((FRAME, encode(FRAME, {**GOOD_FRAME, **change})))
        out.append((FRAME, encode(FRAME, GOOD_FRAME)))
    for change in STATE_CHANGES:
        out.append((STATE, encode(STATE, {**GOOD_STATE, **change})))
        out.append((STATE, encode(STATE, GOOD_STATE)))
    return out


@pytest.mark.parametrize("encoding", ["protobuf", "ros2"])
def test_good_and_bad_messages_are_read_alike(tmp_path, monkeypatch, encoding):
    recorded = encoded(encoding)
    fast = check_same(
        write_raw(tmp_path / "a.mcap", recorded, encoding), monkeypatch, len(recorded)
    )
    assert fast.exposures.num_rows > len(FRAME_CHANGES)
    assert fast.states.num_rows > len(STATE_CHANGES)


def test_a_good_log_is_read_by_the_scans_alone(tmp_path, monkeypatch):
    for encoding in ("protobuf", "ros2"):
        encode = encoding_named(encoding).encode
        recorded = [
            *[(FRAME, encode(FRAME, GOOD_FRAME))] * 10,
            *[(STATE, encode(STATE, GOOD_STATE))] * 10,
        ]
        path = write_raw(tmp_path / "a.mcap", recorded, encoding)
        with monkeypatch.context() as patch:
            patch.setattr(frame_columns.FrameColumns, "_judge", None)
            patch.setattr(state_columns.StateColumns, "_judge", None)
            contents = read_log(path)
        assert (contents.exposures.num_rows, contents.states.num_rows) == (10, 10)


# Protobuf that is written in other ways


def field(number, wire_type, body):
    return varint(number << 3 | wire_type) + body


def packed(number, values):
    return field(number, 2, varint(4 * len(values)) + struct.pack(f"<{len(values)}f", *values))


TIME = field(1, 2, b"\x06" + b"\x08" + varint(1_554_091_200))
ID, NUMBER = field(2, 2, b"\x04sat1"), field(3, 0, b"\x07")
X, Y = packed(5, [1.0, 2.0]), packed(6, [3.0, 4.0])
SOUND = [TIME, ID, NUMBER, field(4, 1, struct.pack("<d", 0.5)), X, Y]
ODD = {
    "sound": SOUND,
    "fields from the last to the first": SOUND[::-1],
    "unknown varint": [*SOUND, field(900, 0, b"\xff\x01")],
    "unknown 64 bits": [field(77, 1, bytes(8)), *SOUND],
    "unknown 32 bits": [*SOUND[:3], field(9, 5, bytes(4)), *SOUND[3:]],
    "unknown bytes": [*SOUND, field(12, 2, b"\x03abc")],
    "unknown group": [*SOUND, field(9, 3, b""), field(9, 4, b"")],
    "unknown negative varint": [*SOUND, field(9, 0, b"\xff" * 9 + b"\x01")],
    "numbers one by one": [*SOUND[:4], *(field(5, 5, struct.pack("<f", v)) for v in (1, 2)), Y],
    "an array in pieces": [*SOUND[:4], packed(5, [1.0]), packed(5, [2.0]), Y],
    "one piece empty": [*SOUND, packed(5, [])],
    "empty arrays": [*SOUND[:4], packed(5, []), packed(6, []), packed(7, [])],
    "no arrays": SOUND[:4],
    "a scalar twice": [*SOUND, field(3, 0, b"\x08")],
    "an id twice": [*SOUND, field(2, 2, b"\x01b")],
    "a time twice": [*SOUND, field(1, 2, b"\x02\x10\x05")],
    "a time with a field more": [field(1, 2, b"\x06\x08\x05\x10\x06\x18\x01"), *SOUND[1:]],
    "a time with seconds twice": [field(1, 2, b"\x04\x08\x05\x08\x06"), *SOUND[1:]],
    "a negative time": [field(1, 2, b"\x0b\x08" + b"\xff" * 9 + b"\x01"), *SOUND[1:]],
    "nanoseconds of a second": [field(1, 2, b"\x08\x08\x05\x10" + varint(10**9)), *SOUND[1:]],
    "nanoseconds of many bits": [field(1, 2, b"\x09\x08\x05\x10" + varint(1 << 33)), *SOUND[1:]],
    "an empty time": [field(1, 2, b"\x00"), *SOUND[1:]],
    "the last time": [field(1, 2, b"\x06\x08" + varint(9_223_372_035)), *SOUND[1:]],
    "a time behind the last": [field(1, 2, b"\x06\x08" + varint(9_223_372_036)), *SOUND[1:]],
    "no time": SOUND[1:],
    "a number as a double": [TIME, ID, field(3, 1, bytes(8)), X, Y],
    "a double as a varint": [TIME, ID, NUMBER, field(4, 0, b"\x05"), X, Y],
    "an array as a varint": [*SOUND[:4], field(5, 0, b"\x01"), Y],
    "an array as a double": [*SOUND[:4], field(5, 1, bytes(8)), Y],
    "a text as a varint": [TIME, field(2, 0, b"\x05"), NUMBER, X, Y],
    "half a number": [*SOUND[:4], field(5, 2, b"\x06" + bytes(6)), Y],
    "long varints": [TIME, ID, field(3, 0, b"\x87\x80\x80\x00"), X, Y],
    "a long tag": [TIME, ID, NUMBER, b"\xad\x80\x80\x00" + X[1:], Y],
    "a tag too long": [TIME, ID, NUMBER, b"\xad\x80\x80\x80\x80\x00" + X[1:], Y],
    "field 0": [*SOUND, b"\x00\x01"],
    "wire type 6": [*SOUND, b"\x2e\x01"],
    "wire type 7": [*SOUND, b"\x2f\x01"],
    "end of no group": [*SOUND, field(9, 4, b"")],
    "a length too long": [*SOUND, field(12, 2, b"\x05abc")],
    "a huge length": [*SOUND, field(12, 2, b"\xff" * 8 + b"\x7f")],
    "the hugest length": [*SOUND, field(12, 2, b"\xff" * 9 + b"\x01")],
    "a varint without an end": [*SOUND, field(12, 0, b"\xff" * 11)],
    "a tag alone": [*SOUND, b"\x2d"],
    "nothing": [],
}


@pytest.mark.parametrize("name", ODD)
def test_protobuf_written_in_another_way_is_read_alike(tmp_path, monkeypatch, name):
    good = (FRAME, b"".join(SOUND))
    odd = (FRAME, b"".join(ODD[name]))
    fast = check_same(write_raw(tmp_path / "a.mcap", [good, odd, odd, good]), monkeypatch, 4)
    assert array(fast.exposures, "frame_number")[[0, -1]].tolist() == [7, 7]


@pytest.mark.parametrize(
    "header", [b"\0\1\0\0", b"\0\7\0\0", b"\0\0\0\0", b"\0\6\0\0", b"\1\1\0\0"]
)
def test_cdr_of_any_header_is_read_alike(tmp_path, monkeypatch, header):
    good = ros2_cdr.encode(FRAME, GOOD_FRAME)
    recorded = [(FRAME, good), (FRAME, header + good[4:])]
    recorded += [(FRAME, good[:n]) for n in range(len(good))]
    recorded += [(FRAME, good + b"\1\2\3")]
    check_same(write_raw(tmp_path / "a.mcap", recorded, "ros2"), monkeypatch, len(recorded))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("encoding", ["protobuf", "ros2"])
def test_damaged_messages_are_read_alike(tmp_path, monkeypatch, encoding, seed):
    rng = random.Random(seed)
    sound = encoded(encoding)
    recorded = [(FRAME, encoding_named(encoding).encode(FRAME, GOOD_FRAME))]
    for _ in range(1500):
        kind, data = rng.choice(sound)
        data = bytearray(data)
        for _ in range(rng.choice((0, 1, 1, 2, 5))):
            if data:
                data[rng.randrange(len(data))] = rng.choice((rng.randrange(256), 0, 255))
        if rng.random() < 0.2:
            del data[rng.randrange(len(data) + 1) :]
        recorded.append((kind, bytes(data)))
    path = write_raw(tmp_path / "a.mcap", recorded, encoding, chunk_size=5000)
    check_same(path, monkeypatch, len(recorded))


def test_more_sensors_than_the_scans_know_are_told_apart(tmp_path, monkeypatch):
    names = [f"s{i % (MAX_NAMES + 50)}" for i in range(2 * MAX_NAMES + 100)]
    recorded = [
        (kind, protobuf.encode(kind, {**good, "sensor_id": name}))
        for name in names
        for kind, good in ((FRAME, GOOD_FRAME), (STATE, GOOD_STATE))
    ]
    fast = check_same(write_raw(tmp_path / "a.mcap", recorded), monkeypatch, len(recorded))
    assert fast.exposures["sensor_id"].to_pylist() == names
    assert fast.states["sensor_id"].to_pylist() == names


def test_a_scan_that_always_stops_is_tried_less_and_less_often(tmp_path, monkeypatch):
    calls = []

    def stop(messages, i, names, rows, n):
        calls.append(i)
        return i, n

    monkeypatch.setattr(frame_columns, "scan_frames", stop)
    frame = (FRAME, protobuf.encode(FRAME, GOOD_FRAME))
    n = 2 * MAX_AT_ONCE
    path = write_raw(tmp_path / "a.mcap", [frame] * n, chunk_size=1 << 24)
    assert read_log(path).exposures.num_rows == n
    assert len(calls) < 20


@pytest.mark.parametrize("encoding", ["protobuf", "json", "ros2"])
def test_every_message_of_a_log_is_read_or_left_out(tmp_path, encoding):
    rng = np.random.default_rng(5)
    with LogWriter(tmp_path / "a.mcap", encoding=encoding, chunk_size=3000) as log:
        for i in range(200):
            x = rng.uniform(0, 500, 3)
            x[0] = rng.choice([x[0], np.nan])
            log.state(
                "sat1", START_NS + i, position_km=[7000.0, 0, 0], frame=rng.choice(["GCRF", "?"])
            )
            log.frame(
                "sat1", START_NS + i, frame_number=i, exposure_s=0.1, x_px=x, y_px=x[: i % 2 + 2]
            )
    contents = read_log(tmp_path / "a.mcap")
    read = contents.exposures.num_rows + contents.states.num_rows
    assert 0 < read < 400
    assert read + sum(contents.rejects["count"].to_pylist()) == 400


def test_a_log_of_odd_messages_alone_has_no_frames(tmp_path):
    path = write_raw(tmp_path / "a.mcap", [(FRAME, b"\x01")] * 5)
    contents = read_log(path)
    assert contents.exposures.num_rows == 0
    assert contents.rejects["reason"].to_pylist() == ["undecodable_frame"] * 5

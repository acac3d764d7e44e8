"""A log that is read in pieces: the same rows as at once, in bounded memory."""

import hashlib
import os
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest
from mcap.writer import CompressionType, Writer

from epipole.io.logs.mcap import records as log_records
from epipole.io.logs.messages import protobuf
from epipole.io.logs.reader import read_log, read_log_pieces
from epipole.io.logs.writer import LogWriter
from epipole.schemas.errors import LogError
from epipole.schemas.log_messages import CENTROID_FRAME, FRAME, SENSOR_STATE, STATE

START_NS = 1_554_091_200_000_000_000
SECOND_NS = 1_000_000_000
N = 2000
MIB = 1 << 20


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    """Return a log of many small chunks, one of them damaged."""
    path = tmp_path_factory.mktemp("pieces") / "a.mcap"
    rng = np.random.default_rng(0)
    with LogWriter(path, chunk_size=4000, compression="none") as out:
        for i in range(N):
            x = rng.uniform(0, 500, 20)
            out.state("sat1", START_NS + i * SECOND_NS, position_km=[7000.0, i, 2.0])
            out.frame(
                "sat1", START_NS + i * SECOND_NS, frame_number=i, exposure_s=0.1, x_px=x, y_px=x
            )
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    return path


@pytest.mark.long
@pytest.mark.parametrize("piece_bytes", [5_000, 50_000, 1 << 30])
def test_the_pieces_are_the_log(log, piece_bytes):
    whole = read_log(log)
    pieces = list(read_log_pieces(log, piece_bytes=piece_bytes))
    for name in ("exposures", "states", "cameras", "rejects"):
        joined = pa.concat_tables([getattr(piece, name) for piece in pieces])
        assert joined.equals(getattr(whole, name))
    assert [piece.source for piece in pieces] == [None] * (len(pieces) - 1) + [whole.source]
    assert whole.rejects.num_rows == 1
    assert (len(pieces) == 1) == (piece_bytes == 1 << 30)


def test_a_piece_is_at_most_a_chunk_larger_than_asked_for(log):
    pieces = list(read_log_pieces(log, piece_bytes=50_000))
    sizes = [piece.exposures.nbytes + piece.states.nbytes for piece in pieces]
    assert all(40_000 < size < 60_000 for size in sizes[:-1])


def test_calibrations_are_read_in_pieces_too(tmp_path):
    names = ("width", "height", "fx_px", "fy_px", "cx_px", "cy_px")
    camera = dict(zip(names, (100, 100, 500.0, 500.0, 50.0, 50.0), strict=True))
    camera |= dict.fromkeys(("k1", "k2", "p1", "p2", "k3"), 0.0)
    with LogWriter(tmp_path / "a.mcap", chunk_size=4000) as out:
        for k in range(1000):
            out.camera("sat1", START_NS + k, camera)
    pieces = list(read_log_pieces(tmp_path / "a.mcap", piece_bytes=100_000))
    assert sum(piece.cameras.num_rows for piece in pieces) == 1000
    assert max(piece.cameras.nbytes for piece in pieces) < 120_000


def test_a_log_without_frames_has_the_times_of_its_states(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as out:
        out.state("sat1", START_NS, position_km=[7000.0, 0.0, 2.0])
    (piece,) = read_log_pieces(tmp_path / "a.mcap")
    assert piece.source is not None
    assert (piece.source.first_time_ns, piece.source.last_time_ns) == (START_NS, START_NS)


def test_reading_may_stop_early(log):
    for _ in read_log_pieces(log, piece_bytes=1):
        break


READ = """
import sys
from epipole.io.logs.reader import read_log_pieces

def resident_mib():
    return int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) / 1024

for piece in read_log_pieces(sys.argv[1], piece_bytes=1 << 20):
    pass
open("/proc/self/clear_refs", "w").write("5")  # the peak so far is forgotten: kernels were loaded
before, n = resident_mib(), 0
for piece in read_log_pieces(sys.argv[2], piece_bytes=8 << 20):
    n += piece.exposures.num_rows
print(n, resident_mib() - before)
"""


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="asks Linux for the memory")
@pytest.mark.parametrize("chunked", [True, False])
def test_the_memory_of_reading_is_bounded_by_its_pieces_not_by_the_log(tmp_path, log, chunked):
    path = tmp_path / "large.mcap"
    values = {"timestamp": START_NS, "sensor_id": "sat1", "exposure_s": 0.1}
    values |= {"flux": None, "sigma_px": None}
    x = np.random.default_rng(0).uniform(0, 500, 2000)
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, use_chunking=chunked)
        writer.start()
        schema = writer.register_schema(CENTROID_FRAME.name, "protobuf", b"")
        channel = writer.register_channel("/a", "protobuf", schema)
        for i in range(12_000):
            frame = {**values, "frame_number": i + 1, "x_px": x, "y_px": x}
            writer.add_message(channel, START_NS, protobuf.encode(FRAME, frame), START_NS)
        writer.finish()
    assert path.stat().st_size > 180 * MIB
    command = [sys.executable, "-c", READ, str(log), str(path)]
    out = subprocess.run(command, capture_output=True, text=True, check=True, cwd=tmp_path).stdout
    n, mib = out.split()
    assert int(n) == 12_000
    assert float(mib) < 150


def test_a_log_that_is_cut_while_it_is_read_is_an_error_of_one_line(tmp_path, log, monkeypatch):
    monkeypatch.setattr(log_records, "AHEAD_BYTES", 10_000)
    path = tmp_path / "a.mcap"
    path.write_bytes(log.read_bytes())
    size = path.stat().st_size
    pieces = read_log_pieces(path, piece_bytes=1)
    next(pieces)
    with path.open("r+b") as file:
        file.truncate(1000)
    with pytest.raises(LogError, match=f"a.mcap: has become shorter than {size:,} bytes"):
        list(pieces)


def rewritten_while_read(path, log, change):
    """Read the first piece, change the bytes of the file in place, read the rest."""
    path.write_bytes(log.read_bytes())
    os.utime(path, ns=(START_NS, START_NS))
    pieces = read_log_pieces(path, piece_bytes=1)
    next(pieces)
    with path.open("r+b") as file:
        change(file)
    return list(pieces)


def test_a_log_that_is_overwritten_while_it_is_read_is_an_error_of_one_line(tmp_path, log):
    with pytest.raises(LogError, match=r"a\.mcap: has changed while it was read; read it when"):
        rewritten_while_read(tmp_path / "a.mcap", log, lambda f: f.write(log.read_bytes()[::-1]))


def test_a_log_that_grows_while_it_is_read_is_read(tmp_path, log):
    def append(file):
        file.seek(0, os.SEEK_END)
        file.write(bytes(1000))

    pieces = rewritten_while_read(tmp_path / "a.mcap", log, append)
    assert pieces[-1].source.sha256 == hashlib.sha256(log.read_bytes()).hexdigest()


def test_a_log_that_is_deleted_while_it_is_read_is_read(tmp_path, log):
    path = tmp_path / "a.mcap"
    path.write_bytes(log.read_bytes())
    pieces = read_log_pieces(path, piece_bytes=1)
    first = next(pieces)
    path.unlink()
    n = first.exposures.num_rows + sum(piece.exposures.num_rows for piece in pieces)
    assert n == read_log(log).exposures.num_rows


def test_messages_outside_chunks_are_read_in_pieces(tmp_path):
    state = {"timestamp": START_NS, "sensor_id": "sat1", "frame": "GCRF", "velocity_km_s": None}
    state |= {"position_km": [7e3, 0, 0], "position_sigma_km": 0.1, "attitude_xyzw": None}
    data = protobuf.encode(STATE, state | {"attitude_sigma_arcsec": 0.0})
    frame = {"timestamp": START_NS, "sensor_id": "sat1", "exposure_s": 0.1, "flux": None}
    frame |= {"frame_number": 1, "x_px": [1.0], "y_px": [1.0], "sigma_px": None}
    path = tmp_path / "a.mcap"
    with path.open("wb") as file:
        writer = Writer(file, use_chunking=False, enable_data_crcs=True)
        writer.start()
        for name in (SENSOR_STATE.name, CENTROID_FRAME.name):
            schema = writer.register_schema(name, "protobuf", b"")
            channel = writer.register_channel("/a", "protobuf", schema)
        for _ in range(100_000):
            writer.add_message(1, START_NS, data, START_NS)
        writer.add_message(channel, START_NS, protobuf.encode(FRAME, frame), START_NS)
        writer.finish()
    pieces = list(read_log_pieces(path, piece_bytes=MIB))
    assert len(pieces) > 1
    assert sum(piece.states.num_rows for piece in pieces) == 100_000
    assert sum(piece.exposures.num_rows for piece in pieces) == 1

"""Small logs that ask for much: memory, time, or rows."""

import struct
import zlib
from collections.abc import Callable

import lz4.frame
import zstandard

from damage.container import (
    CHANNEL,
    CHUNK,
    DATA_END,
    FOOTER,
    HEADER,
    MAGIC,
    MESSAGE,
    SCHEMA,
    Record,
)
from damage.odd_values import with_value
from damage.sound_logs import Form, messages, written
from epipole.io.logs.messages.protobuf import varint
from epipole.schemas.log_messages import FRAME

NAME = b"epipole.CentroidFrame"
_SCHEMA = struct.pack("<HI", 1, len(NAME)) + NAME + bytes(8)
_CHANNEL = struct.pack("<HHI", 1, 1, 2) + b"/a" + struct.pack("<I", 8) + b"protobuf" + bytes(4)
DECLARED = Record(SCHEMA, _SCHEMA).data + Record(CHANNEL, _CHANNEL).data
MILLION = 1_000_000


def bomb_log(*records: bytes) -> bytes:
    """Return a log of these records, closed and without a summary."""
    end = Record(DATA_END, bytes(4)).data + Record(FOOTER, bytes(20)).data
    return MAGIC + Record(HEADER, bytes(8)).data + DECLARED + b"".join(records) + end + MAGIC


def chunk(records: bytes, compression: bytes, packed: bytes, size: int | None = None) -> bytes:
    """Return a chunk; `size`: what it declares, if not the truth."""
    size = len(records) if size is None else size
    head = struct.pack("<QQQI", 1000, 2000, size, zlib.crc32(records))
    name = struct.pack("<I", len(compression)) + compression
    return Record(CHUNK, head + name + struct.pack("<Q", len(packed)) + packed).data


def message(data: bytes = b"") -> bytes:
    """Return a message record."""
    return Record(MESSAGE, struct.pack("<HIQQ", 1, 0, 1000, 0) + data).data


def _zeros_zstd() -> bytes:
    zeros = bytes(200 << 20)
    return bomb_log(chunk(zeros, b"zstd", zstandard.ZstdCompressor().compress(zeros)))


def _zeros_lz4() -> bytes:
    zeros = bytes(100 << 20)
    return bomb_log(chunk(zeros, b"lz4", lz4.frame.compress(zeros)))


def _many_chunks() -> bytes:
    empty = message() * 250_000
    return bomb_log(chunk(empty, b"zstd", zstandard.ZstdCompressor().compress(empty)) * 40)


def _lying_sizes() -> bytes:
    zeros = bytes(60 << 20)
    packed = zstandard.ZstdCompressor().compress(zeros)
    sizes = (0, 1, 1 << 20, 255 << 20, 1 << 28, 1 << 40, (1 << 64) - 1)
    return bomb_log(*(chunk(zeros, b"zstd", packed, size) for size in sizes))


def _endless_frame() -> bytes:
    # A zstd frame that does not say its size, and a window of the largest size.
    options = zstandard.ZstdCompressionParameters.from_level(
        1, window_log=27, write_content_size=False
    )
    packed = zstandard.ZstdCompressor(compression_params=options)
    zeros = bytes(100 << 20)
    return bomb_log(chunk(zeros, b"zstd", packed.compress(zeros), 250 << 20))


def _empty_messages() -> bytes:
    return bomb_log(message() * 100_000)


def _short_records() -> bytes:
    return bomb_log(Record(0x20, b"").data * 200_000)


def _declarations() -> bytes:
    other = Record(CHANNEL, _CHANNEL.replace(b"/a", b"/b")).data
    records = (DECLARED + message() + other + message()) * 10_000
    return bomb_log(chunk(records, b"", records))


def _many_channels() -> bytes:
    channels = b"".join(
        Record(CHANNEL, struct.pack("<H", i) + _CHANNEL[2:]).data for i in range(1 << 16)
    )
    records = DECLARED + channels + message() * 10
    return bomb_log(chunk(records, b"zstd", zstandard.ZstdCompressor().compress(records)))


def _one_large_frame() -> bytes:
    first = next(m for m in messages() if m.kind == FRAME)
    data = with_value("protobuf", first, "x_px", [1.0] * 2 * MILLION)
    assert data is not None
    return written([(first, data)], Form("protobuf"))


def _pieces_of_arrays() -> bytes:
    # An array of one number per piece: each has its own tag and length.
    piece = varint(5 << 3 | 2) + b"\4" + struct.pack("<f", 1.0)
    return bomb_log(message(piece * MILLION))


def _deep_json() -> bytes:
    first = next(m for m in messages() if m.kind == FRAME)
    deep = b'{"x_px":' + b"[" * MILLION + b"]" * MILLION + b"}"
    digits = b'{"frame_number":' + b"9" * MILLION + b"}"
    return written([(first, deep), (first, digits)], Form("json"))


def _many_sensors() -> bytes:
    first = next(m for m in messages() if m.kind == FRAME)
    ids = [with_value("protobuf", first, "sensor_id", f"s{i}") or b"" for i in range(5000)]
    return written([(first, data) for data in ids], Form("protobuf"))


BOMBS: dict[str, Callable[[], bytes]] = {
    "200 MiB of zeros, zstd": _zeros_zstd,
    "100 MiB of zeros, lz4": _zeros_lz4,
    "ten million empty messages in 40 chunks": _many_chunks,
    "chunks that declare other sizes": _lying_sizes,
    "a zstd frame without size, and the widest window": _endless_frame,
    "100,000 empty messages": _empty_messages,
    "200,000 empty records": _short_records,
    "a channel declared 20,000 times in two ways": _declarations,
    "65,536 channels": _many_channels,
    "a frame of two million centroids": _one_large_frame,
    "an array in a million pieces": _pieces_of_arrays,
    "JSON a million lists deep, and a number of a million digits": _deep_json,
    "5,000 sensors": _many_sensors,
}

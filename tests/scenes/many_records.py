"""Logs of very many records of one kind, and what a process of its own needs to read them.

`python tests/scenes/many_records.py KIND:NUMBER...` prints for each the CPU time in seconds, the
memory in MiB that reading adds, and how many records `rejects` counts in how many rows.
"""

import resource
import struct
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for `scenes`, in a process of its own

from epipole.io.logs.reader import read_log_pieces
from epipole.schemas.bridge import array
from scenes.hand_made_logs import (
    DECLARED,
    channel_body,
    chunk,
    hand_made,
    record,
    schema_body,
)

LATE = record(4, channel_body(9))  # behind the messages of the channel
MANY_NUMBERS = 60_000  # of schemas and channels: 16 bits have not many more


def _message(channel: int = 1) -> bytes:
    return record(5, struct.pack("<HIQQ", channel, 0, 1000, 0))


def _bad_chunk() -> bytes:
    return chunk(b"?")[:-1] + b"!"


def _chunk_index(i: int) -> bytes:
    return record(8, struct.pack("<QQQQIQ", 0, 0, 100 + i, 49, 0, 0) + bytes(20))


def _other_schema(i: int) -> bytes:
    return record(3, schema_body(2 + i % MANY_NUMBERS, f"other{i % 1001}"))


def _other_channel(i: int) -> bytes:
    return record(4, channel_body(2 + i % MANY_NUMBERS, 1, f"/{i % 1001}"))


KINDS: dict[str, Callable[[int], bytes]] = {
    "chunks": lambda n: chunk(b"") * n,
    "chunks with a wrong checksum": lambda n: _bad_chunk() * n,
    "messages and chunks in turn": lambda n: (_message() + chunk(b"")) * n,
    "foreign records": lambda n: record(0x20, b"") * n,
    "private records": lambda n: record(0x80, b"") * n,
    "empty data ends": lambda n: record(0x0F, b"") * n,
    "data ends": lambda n: record(0x0F, bytes(4)) * n,
    "headers": lambda n: record(1, b"") * n,
    "message indexes": lambda n: record(7, struct.pack("<HI", 1, 0)) * n,
    "metadata": lambda n: record(0x0C, b"") * n,
    "attachments": lambda n: record(0x09, b"") * n,
    "schemas": lambda n: b"".join(map(_other_schema, range(n))),
    "channels": lambda n: b"".join(map(_other_channel, range(n))),
    "empty messages": lambda n: _message() * n,
    "messages without a channel": lambda n: b"".join(_message(i % 65536) for i in range(n)),
    "logs in sequence": lambda n: hand_made(_message(9), DECLARED, LATE) * n,
    "messages and private records in turn": lambda n: (_message() + record(0x80, b"")) * n,
}


def log_of(kind: str, n: int) -> bytes:
    """Return a log of `n` records of a kind behind a chunk, or of `n` indexes of chunks."""
    if kind == "chunk indexes":
        return hand_made(DECLARED, summary=b"".join(map(_chunk_index, range(n))))
    if kind == "logs in sequence":
        return KINDS[kind](n)
    return hand_made(DECLARED, chunk(b""), KINDS[kind](n))


def _peak_mib() -> float:
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def _measure(path: Path) -> tuple[float, float, int, int]:
    Path("/proc/self/clear_refs").write_text("5")  # the peak so far is forgotten
    before_mib, began = _peak_mib(), resource.getrusage(resource.RUSAGE_SELF)
    rows = count = 0
    for piece in read_log_pieces(path):
        rows, count = rows + len(piece.rejects), count + int(array(piece.rejects, "count").sum())
    ended = resource.getrusage(resource.RUSAGE_SELF)
    cpu_s = ended.ru_utime + ended.ru_stime - began.ru_utime - began.ru_stime
    return cpu_s, _peak_mib() - before_mib, rows, count


def main() -> None:
    """Measure the logs that the arguments name; the first reading compiles and does not count."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "many.mcap"
        path.write_bytes(log_of("empty messages", 10))
        _measure(path)
        for asked in sys.argv[1:]:
            kind, n = asked.rsplit(":", 1)
            path.write_bytes(log_of(kind, int(n)))
            print("{:.3f} {:.1f} {} {}".format(*_measure(path)), flush=True)


if __name__ == "__main__":
    main()

"""The places of all records in a chunk, found by one compiled walk over its bytes."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.io.logs.kernels import kernel
from epipole.io.logs.mcap.byte_loads import load_uint16, load_uint64

Bytes = npt.NDArray[np.uint8]

SCHEMA, CHANNEL, MESSAGE = 0x03, 0x04, 0x05
PRIVATE = 0x80  # opcodes from here on are private to some program; such records are skipped
HEAD_BYTES = 9  # of a record: its type, its length
MESSAGE_BYTES = 22  # of a message before its data: channel, sequence, two times


class RecordIndex(NamedTuple):
    """The messages, schemas and channels among records, in their order.

    `time_ns` and `channel` are of messages, and 0 for other records. `start` to `end` are the
    data of a message, or the whole body of a schema or channel.
    """

    opcode: npt.NDArray[np.uint8]
    channel: npt.NDArray[np.uint16]
    time_ns: npt.NDArray[np.uint64]
    start: npt.NDArray[np.int64]
    end: npt.NDArray[np.int64]
    n_strange: int  # records that do not belong here, and messages that are too short
    walked: int  # bytes up to the end of the walk: all bytes, unless there is damage


def index_records(data: Bytes, only_known: bool = False) -> RecordIndex:
    """Return where the records lie.

    Parameters
    ----------
    data
        Consecutive records.
    only_known
        End at the first record that is not a message, schema or channel. Else it is skipped.
    """
    n, walked, n_strange = _walk(data, only_known, *_columns(0))
    columns = _columns(n)
    _walk(data, only_known, *columns)
    opcode, channel, time_ns, start, end = columns
    return RecordIndex(opcode, channel, time_ns, start, end, n_strange, walked)


def _columns(n: int) -> list[npt.NDArray[Any]]:
    kinds = (np.uint8, np.uint16, np.uint64, np.int64, np.int64)
    return [np.zeros(n, kind) for kind in kinds]


@kernel
def _walk(data, only_known, opcode, channel, time_ns, start, end):
    """Return how many records there are, and write those that the columns have room for."""
    n, n_strange, size, room = 0, 0, len(data), len(opcode)
    at = np.int64(0)
    while at + HEAD_BYTES <= size:
        kind = data[at]
        length = load_uint64(data, at + 1)
        body = at + HEAD_BYTES
        if length > np.uint64(size - body):
            break
        after = body + np.int64(length)
        if kind == MESSAGE and after - body < MESSAGE_BYTES:
            n_strange += 1
        elif kind in (MESSAGE, SCHEMA, CHANNEL):
            if n < room:
                opcode[n] = kind
                start[n], end[n] = body, after
                if kind == MESSAGE:
                    channel[n] = load_uint16(data, body)
                    time_ns[n] = load_uint64(data, body + 6)
                    start[n] = body + MESSAGE_BYTES
            n += 1
        elif only_known:
            break
        elif kind < PRIVATE:
            n_strange += 1
        at = after
    return n, at, n_strange

"""Where records lie, in a chunk or outside chunks: compiled loops over the bytes."""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import njit, types
from numba.extending import intrinsic

from epipole.io.caches.kernels import use_kernel_cache
from epipole.schemas.arrays import Flags, Integers

# Compilation, as in `epipole.tasks.algorithms.kernels`: io may not import it, a test compares both.

use_kernel_cache()

_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": True}

kernel = njit(**_OPTIONS)


# Little-endian numbers at any offset.


def _load(bits: int, kind: Any) -> Any:
    """Return a function of (bytes, offset): one load instruction, which numba has no function for.

    The bytes must reach beyond the number: no bound is checked.
    """

    @intrinsic
    def load(typing_context, data, at):
        def code(context, builder, signature, values):
            array = context.make_array(signature.args[0])(context, builder, values[0])
            address = builder.gep(array.data, [values[1]])
            pointer = builder.bitcast(address, ir.IntType(bits).as_pointer())
            return builder.load(pointer, align=1)

        return kind(data, types.int64), code

    return load


load_uint16 = _load(16, types.uint16)
load_int32 = _load(32, types.int32)
load_uint32 = _load(32, types.uint32)
load_uint64 = _load(64, types.uint64)


# Records.

Bytes = npt.NDArray[np.uint8]
Hashes = npt.NDArray[np.uint64]

HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
ATTACHMENT, METADATA, DATA_END = 0x09, 0x0C, 0x0F
CHUNK_INDEX, STATISTICS = 0x08, 0x0B
# Schemas, channels, indexes of chunks, attachments and metadata, statistics, offsets.
OF_SUMMARY = (SCHEMA, CHANNEL, CHUNK_INDEX, 0x0A, STATISTICS, 0x0D, 0x0E)
PRIVATE = 0x80  # opcodes from here on are private to some program; such records are skipped
HEAD_BYTES = 9  # of a record: its type, its length
MESSAGE_BYTES = 22  # of a message before its data: channel, sequence, two times
SCHEMA_BYTES, CHANNEL_BYTES = 6, 12  # of a schema and a channel at least, with empty texts
INDEX_BYTES = 6  # of a message index before its entries: channel, bytes of the entries
ENTRY_BYTES = 16  # of an entry of a message index
# Records in one index, so that its size is bounded: 35 bytes each. Most chunks have fewer.
MAX_RECORDS = 1 << 20


class RecordIndex(NamedTuple):
    """The messages, schemas and channels among records, in their order.

    `time_ns` and `channel` are of messages, and 0 for other records. `start` to `end` are the
    data of a message, or the whole body of a schema or channel.
    """

    opcode: npt.NDArray[np.uint8]
    channel: npt.NDArray[np.uint16]
    time_ns: npt.NDArray[np.uint64]
    start: Integers
    end: Integers
    n_strange: int  # records that do not belong here or are too short
    first_strange: int  # where the first of these begins
    walked: int  # bytes up to the end of the walk: all bytes, unless there is damage


def index_records(data: Bytes, outside: bool = False) -> Iterator[RecordIndex]:
    """Yield where the records lie, at most `MAX_RECORDS` at once.

    Parameters
    ----------
    data
        Consecutive records.
    outside
        They lie outside chunks (see `length_outside`), where attachments and metadata belong.
    """
    at, more = 0, True
    while more:
        n, *_ = _walk(data, at, outside, False, MAX_RECORDS, *_columns(0))
        columns = _columns(n)
        _, at, n_strange, first_strange = _walk(data, at, outside, False, n, *columns)
        more = n == MAX_RECORDS and at < len(data)
        opcode, channel, time_ns, start, end = columns
        yield RecordIndex(opcode, channel, time_ns, start, end, n_strange, first_strange, at)


def length_outside(data: Bytes) -> int:
    """Return the length [bytes] of the records up to the first chunk, or the end of the data."""
    return int(_walk(data, 0, True, True, len(data), *_columns(0))[1])


def _columns(n: int) -> list[npt.NDArray[Any]]:
    kinds = (np.uint8, np.uint16, np.uint64, np.int64, np.int64)
    return [np.zeros(n, kind) for kind in kinds]


@kernel
def _ends_run(data, kind, after):
    """Return whether a record outside chunks ends a run of records.

    `kind` is its opcode, `after` the offset behind it in `data`, which are bytes.
    """
    if kind == DATA_END and after < len(data):
        # Where no summary follows, it ends nothing.
        return data[after] >= PRIVATE or data[after] == FOOTER or data[after] in OF_SUMMARY
    return kind in (0, CHUNK, MESSAGE_INDEX, DATA_END)


@kernel
def _least_bytes(kind):
    """Return the minimum length [bytes] of a message, schema or channel; 0 for other opcodes."""
    if kind == MESSAGE:
        return MESSAGE_BYTES
    if kind == SCHEMA:
        return SCHEMA_BYTES
    return CHANNEL_BYTES if kind == CHANNEL else 0


@kernel
def _walk(data, at, outside, ends, most, opcode, channel, time_ns, start, end):
    """Return how many records there are, and write those that the columns have room for.

    Parameters
    ----------
    data, at
        Bytes, and the offset of the first record.
    outside, ends
        The records are a run outside chunks; the walk ends where that run does.
    most
        The walk ends before record number `most` + 1.
    opcode, channel, time_ns, start, end : (n,)
        The columns: those of `RecordIndex`.

    Returns
    -------
    int, int
        How many there are, and the offset behind the last.
    int, int
        The number of strange records, which have no row, and the offset of the first.
    """
    n, n_strange, first_strange, size, room = 0, 0, np.int64(0), len(data), len(opcode)
    at = np.int64(at)
    while at + HEAD_BYTES <= size:
        kind = data[at]
        length = load_uint64(data, at + 1)
        body = at + HEAD_BYTES
        if length > np.uint64(size - body):
            break
        after = body + np.int64(length)
        if ends and _ends_run(data, kind, after):
            break
        least = _least_bytes(kind)
        if least and after - body >= least:
            if n == most:
                break
            if n < room:
                opcode[n] = kind
                start[n], end[n] = body, after
                if kind == MESSAGE:
                    channel[n] = load_uint16(data, body)
                    time_ns[n] = load_uint64(data, body + 6)
                    start[n] = body + MESSAGE_BYTES
            n += 1
        elif least or (kind < PRIVATE and not (outside and kind in (ATTACHMENT, METADATA))):
            if n_strange == 0:
                first_strange = at
            n_strange += 1
        at = after
    return n, at, n_strange, first_strange


def index_counts(data: Bytes, limit: int) -> tuple[npt.NDArray[Any], npt.NDArray[Any], int]:
    """Return the channel and the number of messages of each message index, and where they end.

    `data` begins with a message index; entries of the last one may lie behind it, up to `limit`.
    The walk ends at the first other or invalid record.
    """
    most = len(data) // (HEAD_BYTES + INDEX_BYTES)
    number, counted = np.zeros(most, np.uint16), np.zeros(most, np.int64)
    n, at = _walk_indexes(data, limit, number, counted)
    return number[:n], counted[:n], at


@kernel
def _walk_indexes(data, limit, number, counted):
    """Write channel and number of messages of each message index; see `index_counts`.

    `number` and `counted` (n,) have room for all in `data`. Returns how many were written, and
    where they end.
    """
    n, at = 0, np.int64(0)
    while at + HEAD_BYTES + INDEX_BYTES <= len(data) and data[at] == MESSAGE_INDEX:
        length = load_uint64(data, at + 1)
        body = at + HEAD_BYTES
        size = np.uint64(load_uint32(data, body + 2))
        if length > np.uint64(limit - body) or length < np.uint64(INDEX_BYTES) + size:
            break
        if size % np.uint64(ENTRY_BYTES):
            break
        number[n], counted[n] = load_uint16(data, body), size // np.uint64(ENTRY_BYTES)
        n += 1
        at = body + np.int64(length)
    return n, at


def changed_declarations(data: Bytes, index: RecordIndex, last: Hashes) -> Flags:
    """Return (n,) bool: false for declarations that repeat the last one of the same number.

    Some recorders declare a channel before each of its messages. `last` are the hashes of the last
    declarations, from `no_declarations`; they are updated. True for messages.
    """
    return _changed(data, index.opcode, index.start, index.end, last)


def no_declarations() -> Hashes:
    """Return the hashes for `changed_declarations` before any declaration: all zero."""
    return np.zeros((2, 1 << 16), np.uint64)


@kernel
def _changed(data, opcode, start, end, last):
    """Return which records are no repetition, (n,) bool; see `changed_declarations`.

    The columns (n,) are of `RecordIndex`; `last` (2, 65536), schemas and channels, is updated.
    """
    changed = np.ones(len(opcode), np.bool_)
    for i in range(len(opcode)):
        if opcode[i] == MESSAGE:
            continue
        total = np.uint64(0xCBF29CE484222325)  # FNV-1a of 64 bits
        for at in range(start[i], end[i]):
            total = (total ^ np.uint64(data[at])) * np.uint64(0x100000001B3)
        number = load_uint16(data, start[i])
        changed[i] = last[opcode[i] - SCHEMA, number] != total
        last[opcode[i] - SCHEMA, number] = total
    return changed

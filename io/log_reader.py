"""Logs in: an MCAP file of frames, states and calibrations to tables.

Channels are chosen by the name of their schema, in protobuf, JSON or ROS 2 CDR, mixed as
they may be. Nothing that is in the file stops the reading: what cannot be used is a row
in `rejects`. Only a log that gives no frame at all is an error.
"""

import hashlib
import os
from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.io.camera_columns import CameraColumns
from epipole.io.frame_columns import FrameColumns
from epipole.io.log_bytes import forget, open_log
from epipole.io.log_channels import ChannelTable
from epipole.io.log_records import Block, RecordWalk
from epipole.io.log_rejects import RejectList
from epipole.io.log_summary import MAGIC, read_summary
from epipole.io.message_decoding import ENCODINGS
from epipole.io.message_parts import Part
from epipole.io.state_columns import StateColumns
from epipole.schemas.bridge import array
from epipole.schemas.errors import LogError
from epipole.schemas.log_tables import LogPart, LogSource
from epipole.schemas.messages import CALIBRATION, CARRIES, FRAME, STATE

THREADS = 2  # that unpack and check chunks, beside the one that decodes
HASHED_BYTES = 4 << 20  # of a file at once
KINDS = (FRAME, STATE, CALIBRATION)
# A frame's time and the time it was logged at may be so far apart, no further, for chunks
# to be judged by the latter. States that far beyond a range help its first and last frames.
MARGIN_NS = 600_000_000_000
FIRST_NS, LAST_NS = 0, (1 << 63) - 1 - MARGIN_NS
# A calibration holds until the next one, so it may lie far before a range.
ALWAYS_READ = frozenset(name for name, carries in CARRIES.items() if carries == CALIBRATION)


def read_log(
    path: str | os.PathLike[str], start_ns: int | None = None, end_ns: int | None = None
) -> LogPart:
    """Return what a log holds, in the order of the file.

    Parameters
    ----------
    path
        A local file or an fsspec URL such as ``s3://bucket/night.mcap``.
    start_ns, end_ns
        Frames from the one to before the other only (UTC since 1970; none: no limit), states
        within `MARGIN_NS` of them, all calibrations. Chunks of another time are passed over
        unopened where the log's own times can be trusted.

    Returns
    -------
    LogPart
        Exposures, states (in their own frames), cameras, rejects and the source's row.
        The offset of a row is the place of its message's chunk in the file.

    Raises
    ------
    LogError
        No such file, a folder, no MCAP, messages in an unknown encoding, no frame. That none
        lies in the range is no error.
    """
    where = os.fspath(path)
    data = _open_mcap(where)
    name = where.rstrip("/").rpartition("/")[2]
    span = None
    if start_ns is not None or end_ns is not None:
        span = (FIRST_NS if start_ns is None else start_ns, LAST_NS if end_ns is None else end_ns)
    with ThreadPoolExecutor(THREADS, "open chunks") as pool:
        sha256 = pool.submit(_sha256, data)
        columns, sure = _read_columns(data, where, name, span, pool)
        if not sure:
            columns, _ = _read_columns(data, where, name, span, pool, pass_over=False)
    frames, states, cameras, rejects = columns
    exposures, log_states = frames.table(), states.table()
    if exposures.num_rows == 0 and span is None:
        raise LogError(f"{where}: no frames in it; {_advice(rejects)}")
    first, last = _time_span(exposures, log_states, span)
    source = LogSource(name, len(data), sha256.result(), first, last)
    left_out = rejects.table(first, last, span)
    return LogPart(exposures, log_states, cameras.table(), left_out, source)


def read_log_times(path: str | os.PathLike[str]) -> tuple[int, int] | None:
    """Return when a log's first and last message were logged, without reading them.

    UTC nanoseconds since 1970, of the recorder's clock: not the times of frames. None where
    the log has no sound summary (it was never closed): then only `read_log` can tell.

    Raises
    ------
    LogError
        No such file, a folder, no MCAP.
    """
    data = _open_mcap(os.fspath(path))
    return read_summary(data, ChannelTable(frozenset())).logged_ns


def _open_mcap(where: str) -> memoryview:
    data = open_log(where)
    if data[: len(MAGIC)] != MAGIC:
        raise LogError(f"{where}: not an MCAP file; give a log as MCAP (https://mcap.dev)")
    return data


class Columns(NamedTuple):
    """What a log's messages become."""

    frames: FrameColumns
    states: StateColumns
    cameras: CameraColumns
    rejects: RejectList


def _read_columns(
    data: memoryview,
    where: str,
    name: str,
    span: tuple[int, int] | None,
    pool: Executor,
    pass_over: bool = True,
) -> tuple[Columns, bool]:
    """Take every wanted message of a span into the columns of its kind.

    Return also whether all are there. They may not be where chunks were passed over and the
    frames that were read are of another time than they were logged at.
    """
    wide = None if span is None else (span[0] - MARGIN_NS, span[1] + MARGIN_NS)
    rejects = RejectList(name)
    columns = Columns(
        FrameColumns(rejects, span), StateColumns(rejects, wide), CameraColumns(rejects), rejects
    )
    takers = (columns.frames, columns.states, columns.cameras)  # as in `KINDS`
    walk = RecordWalk(data, frozenset(CARRIES), pool, wide if pass_over else None, ALWAYS_READ)
    for block in walk.blocks():
        for i, chosen in _kinds(block, where):
            takers[i].add(Part(block, KINDS[i], chosen, rejects))
    for damage in walk.damage:
        rejects.add(damage.reason, time_ns=damage.time_ns, offset=damage.offset, count=damage.n)
    off_ns = columns.frames.clock_off_ns
    return columns, not walk.n_passed or (off_ns is not None and off_ns <= MARGIN_NS)


def _sha256(data: memoryview) -> str:
    digest = hashlib.sha256()
    for at in range(0, len(data), HASHED_BYTES):
        digest.update(data[at : at + HASHED_BYTES])
        forget(data, at, at + HASHED_BYTES)
    return digest.hexdigest()


def _time_span(
    exposures: pa.Table, states: pa.Table, span: tuple[int, int] | None
) -> tuple[int, int]:
    """Return the first and the last time of what was read: of frames, if there are any."""
    for rows in (exposures, states):
        if rows.num_rows:
            time_ns = array(rows, "time")
            return int(time_ns.min()), int(time_ns.max())
    return (0, 0) if span is None else (span[0], span[0])


def _kinds(block: Block, where: str) -> Iterator[tuple[int, npt.NDArray[np.int64]]]:
    """Yield the place in `KINDS` of what messages of a block carry, and which do."""
    code = np.zeros(max(block.channels) + 1, np.uint8)
    for number, channel in block.channels.items():
        if channel.encoding not in ENCODINGS:
            raise LogError(
                f"{where}: topic {channel.topic}: messages are encoded as {channel.encoding!r}; "
                f"write {channel.schema} as one of {', '.join(ENCODINGS)}"
            )
        code[number] = KINDS.index(CARRIES[channel.schema])
    of_message = code[block.channel]
    for i in np.unique(code[list(block.channels)]).tolist():
        yield i, np.flatnonzero(of_message == i)


def _advice(rejects: RejectList) -> str:
    left_out = rejects.summary()
    if left_out:
        return f"left out: {left_out}; check the recording"
    return "record epipole.CentroidFrame messages (the schema's name decides, not the topic)"

"""Logs in: an MCAP file of frames, states and calibrations to tables.

Channels are chosen by the name of their schema, in protobuf, JSON or ROS 2 CDR, mixed as
they may be. Nothing that is in the file stops the reading: what cannot be used is a row
in `rejects`. Only a log that gives no frame at all is an error.
"""

import hashlib
import mmap
import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from epipole.io.camera_columns import CameraColumns
from epipole.io.frame_columns import FrameColumns
from epipole.io.log_records import Block, RecordWalk
from epipole.io.log_rejects import RejectList
from epipole.io.log_summary import MAGIC
from epipole.io.message_decoding import ENCODINGS
from epipole.io.message_parts import Part
from epipole.io.state_columns import StateColumns
from epipole.schemas.bridge import array
from epipole.schemas.errors import LogError
from epipole.schemas.log_tables import LogPart, LogSource
from epipole.schemas.messages import CALIBRATION, CARRIES, FRAME, STATE

THREADS = 2  # that unpack and check chunks, beside the one that decodes


def read_log(path: str | os.PathLike[str]) -> LogPart:
    """Return what a log holds, in the order of the file.

    Parameters
    ----------
    path
        A local file or an fsspec URL such as ``s3://bucket/night.mcap``.

    Returns
    -------
    LogPart
        Exposures, states (in their own frames), cameras, rejects and the source's row.
        The offset of a row is the place of its message's chunk in the file.

    Raises
    ------
    LogError
        No such file, a folder, no MCAP, messages in an unknown encoding, no frame.
    """
    where = os.fspath(path)
    data = _open(where)
    if data[: len(MAGIC)] != MAGIC:
        raise LogError(f"{where}: not an MCAP file; give a log as MCAP (https://mcap.dev)")
    name = where.rstrip("/").rpartition("/")[2]
    rejects = RejectList(name)
    frames, states, cameras = (
        FrameColumns(rejects),
        StateColumns(rejects),
        CameraColumns(rejects),
    )
    _read_messages(data, where, rejects, {FRAME: frames, STATE: states, CALIBRATION: cameras})
    exposures = frames.table()
    if exposures.num_rows == 0:
        raise LogError(f"{where}: no frames in it; {_advice(rejects)}")
    times = array(exposures, "time")
    first, last = int(times.min()), int(times.max())
    source = LogSource(name, len(data), hashlib.sha256(data).hexdigest(), first, last)
    return LogPart(exposures, states.table(), cameras.table(), rejects.table(first, last), source)


def _open(where: str) -> memoryview:
    """Return the bytes of a local file (mapped, not read) or of a URL."""
    if "://" in where:
        return _open_url(where)
    path = Path(where)
    if path.is_dir():
        raise LogError(f"{where}: is a folder; give the logs in it, such as {where}/*.mcap")
    try:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size == 0:
                return memoryview(b"")
            return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ))
    except FileNotFoundError as error:
        raise LogError(f"{where}: no such file; check the path") from error
    except OSError as error:
        raise LogError(f"{where}: cannot be read: {error.strerror}") from error


def _open_url(where: str) -> memoryview:
    try:
        import fsspec
    except ImportError as error:
        raise LogError(f"{where}: URLs need the package fsspec; install it") from error
    try:
        with fsspec.open(where, "rb") as file:
            return memoryview(file.read())
    except (OSError, ValueError, ImportError) as error:
        raise LogError(f"{where}: cannot be read: {_line(error)}") from error


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def _read_messages(
    data: memoryview, where: str, rejects: RejectList, columns: dict[str, Any]
) -> None:
    """Take every wanted message into the columns of its kind."""
    with ThreadPoolExecutor(THREADS, "open chunks") as pool:
        walk = RecordWalk(data, frozenset(CARRIES), pool)
        for block in walk.blocks():
            for carries, chosen in _kinds(block, where):
                columns[carries].add(Part(block, carries, chosen, rejects))
    for damage in walk.damage:
        rejects.add(damage.reason, time_ns=damage.time_ns, offset=damage.offset, count=damage.n)


def _kinds(block: Block, where: str) -> Iterator[tuple[str, npt.NDArray[np.int64]]]:
    """Yield what the messages of a block carry, and which of them carry it."""
    code = np.zeros(max(block.channels) + 1, np.uint8)
    kinds = (FRAME, STATE, CALIBRATION)
    for number, channel in block.channels.items():
        if channel.encoding not in ENCODINGS:
            raise LogError(
                f"{where}: topic {channel.topic}: messages are encoded as {channel.encoding!r}; "
                f"write {channel.schema} as one of {', '.join(ENCODINGS)}"
            )
        code[number] = kinds.index(CARRIES[channel.schema])
    of_message = code[block.channel]
    for i in np.unique(code[list(block.channels)]).tolist():
        yield kinds[i], np.flatnonzero(of_message == i)


def _advice(rejects: RejectList) -> str:
    left_out = rejects.summary()
    if left_out:
        return f"left out: {left_out}; check the recording"
    return "record epipole.CentroidFrame messages (the schema's name decides, not the topic)"

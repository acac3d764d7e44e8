"""Read a log: an MCAP file of frames, states and calibrations becomes tables.

Channels are chosen by the name of their schema. Their messages may be in any registered
encoding, and one log may mix encodings. Damage does not stop the reading: what cannot be used
becomes a row of `rejects`. A log without frames is part of its night too: its states may
be those of another log's frames.
"""

import logging
import os
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ThreadPoolExecutor

import numpy as np
import pyarrow as pa

from epipole.io.logs.left_out import RejectList, log_time_range, stray_rejects, without_strays
from epipole.io.logs.logged_times import open_mcap
from epipole.io.logs.mcap.bytes import LogBytes
from epipole.io.logs.mcap.container import Channel
from epipole.io.logs.mcap.records import Block, RecordWalk
from epipole.io.logs.messages.batches import batches_of
from epipole.io.logs.messages.cameras import CameraColumns
from epipole.io.logs.messages.encoding import StateMessage
from epipole.io.logs.messages.frames import FrameColumns
from epipole.io.logs.messages.registry import kinds_of_schemas, message_encodings
from epipole.io.logs.messages.states import StateColumns
from epipole.io.paths import known_as
from epipole.schemas.arrays import Integers, Nanoseconds
from epipole.schemas.bridge import array
from epipole.schemas.log_messages import CALIBRATION, FRAME, KINDS, STATE
from epipole.schemas.rejects import Reason
from epipole.schemas.tables import REJECTS
from epipole.schemas.text import as_line
from epipole.schemas.work_tables import LogContents, LogPiece, LogSource

LOGGER = logging.getLogger(__name__)


PER_MESSAGE = ("channel", "time_ns", "start", "end", "offset")  # columns of a block
THREADS = 2  # that decompress and check chunks, in addition to the one that decodes
MAX_WARNINGS = 20  # of unknown encodings in one log: it may have 65,536 channels
LONGEST_NAME = 80  # of a topic or an encoding in a message
PIECE_BYTES = 64 << 20  # of frames, states and calibrations in one piece of a log


def read_log(path: str | os.PathLike[str]) -> LogContents:
    """Return what a log holds, in the order of the file (see `read_log_pieces`).

    Parameters
    ----------
    path
        A local file or an fsspec URL such as ``s3://bucket/night.mcap``.

    Returns
    -------
    LogContents
        Exposures, states (each in its reference frame), cameras, rejects and the row of
        `sources`. The offset of a row is that of its message's chunk in the file.

    Raises
    ------
    LogError
        Where there is no such file, or it is a folder or not MCAP.
    """
    pieces = list(read_log_pieces(path))
    exposures, states, cameras, rejects = (
        pa.concat_tables([getattr(piece, name) for piece in pieces])
        for name in ("exposures", "states", "cameras", "rejects")
    )
    source = pieces[-1].source
    assert source is not None  # the last piece has it
    if source.first_time_ns is not None and source.last_time_ns is not None:
        time_range = source.first_time_ns, source.last_time_ns
        exposures, strays = without_strays(exposures, *time_range)
        rejects = pa.concat_tables([rejects, stray_rejects(strays)])
    return LogContents(exposures, states, cameras, rejects, source)


def read_log_pieces(
    path: str | os.PathLike[str],
    piece_bytes: int = PIECE_BYTES,
    as_meant: Callable[[StateMessage], StateMessage] | None = None,
) -> Iterator[LogPiece]:
    """Yield what `read_log` returns in pieces, so that a log need not fit into memory.

    A piece has about `piece_bytes` of frames, states and calibrations, at most one chunk of the
    log more. Each message comes once, in the order of the file. There is at least one piece. The
    last one has the rejects and the source, with the log's time range: frames outside it are
    strays. `as_meant` corrects states that a log has wrong in a known way.
    """
    where = known_as(os.fspath(path))
    with open_mcap(where) as data, ThreadPoolExecutor(THREADS, "open chunks") as pool:
        reading = _Reading(where, data, pool, as_meant)
        for block in reading.blocks():
            known = reading.in_known_encodings(block)
            for kind, chosen in _by_kind(known):
                for batch in batches_of(known, kind, chosen, reading.rejects):
                    reading.columns[kind].add(batch)
            if reading.n_bytes >= piece_bytes:
                yield reading.piece()
        yield reading.last_piece()


class _Reading:
    """One log while it is read: the rows of its messages until they are taken."""

    def __init__(
        self, where: str, data: LogBytes, pool: Executor,
        as_meant: Callable[[StateMessage], StateMessage] | None,
    ) -> None:  # fmt: skip
        self._where, self._data = where, data
        self._name = where.rstrip("/").rpartition("/")[2]
        self.rejects = RejectList(self._name)
        self._frames = FrameColumns(self.rejects)
        self._states = StateColumns(self.rejects, as_meant)
        self._cameras = CameraColumns(self.rejects)
        self.columns: dict[str, FrameColumns | StateColumns | CameraColumns] = {
            FRAME: self._frames,
            STATE: self._states,
            CALIBRATION: self._cameras,
        }
        self._walk = RecordWalk(data, frozenset(kinds_of_schemas()), pool)
        self._frames_ns: list[Nanoseconds] = []
        self._states_ns: list[Nanoseconds] = []
        # Channels in unknown encodings, by number, with the number of their messages.
        self._unknown: dict[int, tuple[Channel, int]] = {}

    def blocks(self) -> Iterator[Block]:
        """Yield the wanted messages of the log."""
        return self._walk.blocks()

    @property
    def n_bytes(self) -> int:
        """The size of the rows that have not been taken."""
        return sum(columns.n_bytes for columns in self.columns.values())

    def piece(self) -> LogPiece:
        """Return the rows since the last piece."""
        exposures, states = self._frames.take(), self._states.take()
        self._frames_ns.append(array(exposures, "time"))
        self._states_ns.append(array(states, "time"))
        return LogPiece(exposures, states, self._cameras.take(), REJECTS.empty_table(), None)

    def last_piece(self) -> LogPiece:
        """Return the remaining rows, the rejects of the whole log, and its source."""
        piece = self.piece()
        for damage in self._walk.damage:
            self.rejects.add(
                damage.reason, time_ns=damage.time_ns, offset=damage.offset, count=damage.n
            )
        for i, (channel, count) in enumerate(self._unknown.values()):
            LOGGER.log(
                logging.WARNING if i < MAX_WARNINGS else logging.DEBUG,
                "%s: topic %s: messages are encoded as %s; write %s as one of %s",
                self._where, as_line(channel.topic, LONGEST_NAME),
                as_line(repr(channel.encoding), LONGEST_NAME), channel.schema,
                ", ".join(message_encodings()),
            )  # fmt: skip
            self.rejects.add(Reason.UNKNOWN_ENCODING, time_ns=0, count=count)
        time_range = log_time_range(self._frames_ns) or log_time_range(self._states_ns)
        first, last = time_range or (None, None)
        source = LogSource(self._name, len(self._data), self._data.sha256(), first, last)
        return piece._replace(rejects=self.rejects.table(time_range), source=source)

    def in_known_encodings(self, block: Block) -> Block:
        """Return the messages of the channels whose encoding is registered; count the others."""
        encodings = message_encodings()
        known = {n: c for n, c in block.channels.items() if c.encoding in encodings}
        if len(known) == len(block.channels):
            return block
        for number, channel in block.channels.items():
            if number not in known:
                count = int(np.count_nonzero(block.channel == number))
                _, before = self._unknown.get(number, (channel, 0))
                self._unknown[number] = channel, before + count
        keep = np.isin(block.channel, list(known))
        columns = {name: getattr(block, name)[keep] for name in PER_MESSAGE}
        return block._replace(channels=known, **columns)


def _by_kind(block: Block) -> Iterator[tuple[str, Integers]]:
    """Yield the kinds of message in a block, each with the numbers of its messages."""
    if not block.channels:
        return
    kinds = kinds_of_schemas()
    code = np.zeros(max(block.channels) + 1, np.uint8)
    for number, channel in block.channels.items():
        code[number] = KINDS.index(kinds[channel.schema])
    of_message = code[block.channel]
    for i in np.unique(code[list(block.channels)]).tolist():
        yield KINDS[i], np.flatnonzero(of_message == i)

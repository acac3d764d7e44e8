"""Read logs: the content of each goes into the work folder, piece by piece."""

import logging
from collections.abc import Sequence
from typing import NamedTuple

import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.logs.reader import read_log_pieces
from epipole.io.paths import local_size
from epipole.io.work.parts import LOG_PIECE, write_part
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.arrays import Nanoseconds
from epipole.schemas.bridge import array
from epipole.schemas.settings import Assumption
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import LogSource
from epipole.tasks.common.batches import FRAMES_OF_TASK, Batch
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.read.assume_readings import as_assumed, as_assumed_source, in_kilometres

LOGGER = logging.getLogger(__name__)

BYTES_OF_FRAME = 500  # of 25 centroids and a state, compressed


class LogToRead(NamedTuple):
    """A log of a run: its number there, and its path or URL."""

    number: int
    path: str

    def __str__(self) -> str:
        """Return the path."""
        return self.path


class SensorInLog(NamedTuple):
    """What a log has of a sensor: which pieces have frames or states of it, and its frames."""

    pieces: list[int]
    n_frames: int


class ReadLog(NamedTuple):
    """A log that was read: its number in the run, how many pieces it has, and its sensors."""

    number: int
    n_pieces: int
    source: LogSource
    sensors: dict[str, SensorInLog]
    n_cameras: int = 0

    @property
    def is_source(self) -> bool:
        """Whether anything in it can be used."""
        return bool(self.sensors or self.n_cameras)


def about_frames(log: str) -> int:
    """Return about how many frames a log has, by its size; one behind a URL has a task's work."""
    size = local_size(log)
    return FRAMES_OF_TASK if size is None else size // BYTES_OF_FRAME


@stage_task(Stage.READ, "{logs}", retried=True)
def read_logs(
    folder: ReadFolder, logs: Batch[LogToRead], assumptions: Sequence[Assumption] = ()
) -> list[ReadLog]:
    """Read some logs, each into pieces of bounded size; see `read_log_into`."""
    return [read_log_into(folder, *log, assumptions) for log in logs]


def read_log_into(
    folder: ReadFolder, number: int, path: str, assumptions: Sequence[Assumption] = ()
) -> ReadLog:
    """Read one log into pieces of bounded size.

    Each piece holds `exposures`, `states`, `cameras` and `rejects` as `LogPiece` has them, read as
    the settings assume.

    Raises
    ------
    LogError
        If it is not a log; see `read_log_pieces`.
    """
    n_pieces, n_cameras, source = 0, 0, None
    times_ns: tuple[list[Nanoseconds], list[Nanoseconds]] = [], []  # of frames, of states
    sensors: dict[str, SensorInLog] = {}
    for written in read_log_pieces(path, as_meant=in_kilometres(assumptions)):
        piece = as_assumed(written, assumptions)
        write_part(
            folder.piece(number, n_pieces),
            LOG_PIECE,
            {name: getattr(piece, name) for name in LOG_PIECE},
            within=folder.root,
        )
        for sensor_id, n_frames in _frames_of(piece.exposures, piece.states).items():
            before = sensors.get(sensor_id, SensorInLog([], 0))
            sensors[sensor_id] = SensorInLog([*before.pieces, n_pieces], before.n_frames + n_frames)
        n_pieces += 1
        n_cameras += piece.cameras.num_rows
        source = piece.source or source
        if assumptions:
            times_ns[0].append(array(piece.exposures, "time"))
            times_ns[1].append(array(piece.states, "time"))
    assert source is not None, "the last piece has it"
    source = as_assumed_source(source, *times_ns, assumptions)
    n_frames = sum(found.n_frames for found in sensors.values())
    LOGGER.debug("%s: read %d frames in %d pieces", source.name, n_frames, n_pieces)
    return ReadLog(number, n_pieces, source, sensors, n_cameras)


def _frames_of(exposures: pa.Table, states: pa.Table) -> dict[str, int]:
    """Return the number of frames of each sensor in a piece, also of those with states only."""
    found = dict.fromkeys(pc.unique(states["sensor_id"]).to_pylist(), 0)
    for counted in pc.value_counts(exposures["sensor_id"]).to_pylist():
        found[counted["values"]] = counted["counts"]
    return found

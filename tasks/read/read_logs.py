"""Read logs: the content of each goes into the work folder, piece by piece."""

import logging
from typing import NamedTuple

from epipole.io.logs.reader import read_log_pieces
from epipole.io.work.parts import LOG_PIECE, write_part
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import LogSource
from epipole.tasks.common.stage_tasks import stage_task

LOGGER = logging.getLogger(__name__)


class ReadLog(NamedTuple):
    """A log that was read: its number in the run, and how many pieces it has."""

    number: int
    n_pieces: int
    source: LogSource


@stage_task(Stage.READ, "{path}", retried=True)
def read_log_into(folder: ReadFolder, number: int, path: str) -> ReadLog:
    """Read one log into pieces of bounded size.

    Each piece holds `exposures`, `states`, `cameras` and `rejects` as `LogPiece` has them.

    Raises
    ------
    LogError
        If it is not a log; see `read_log_pieces`.
    """
    n_pieces, n_frames, source = 0, 0, None
    for piece in read_log_pieces(path):
        write_part(
            folder.piece(number, n_pieces),
            LOG_PIECE,
            {
                "exposures": piece.exposures,
                "states": piece.states,
                "cameras": piece.cameras,
                "rejects": piece.rejects,
            },
            within=folder.root,
        )
        n_pieces += 1
        n_frames += piece.exposures.num_rows
        source = piece.source or source
    assert source is not None, "the last piece has it"
    LOGGER.info("%s: read %d frames in %d pieces", source.name, n_frames, n_pieces)
    return ReadLog(number, n_pieces, source)

"""Read logs: what each holds goes into the work folder, part by part, as the log has it."""

import logging
import os
from pathlib import Path
from typing import NamedTuple

from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.io.logs.reader import read_log_parts
from epipole.io.work.files import write_part
from epipole.schemas.log_tables import LogSource
from epipole.tasks.common.retries import DELAYS_S, RETRIES, storage_failed

LOGGER = logging.getLogger(__name__)


class ReadLog(NamedTuple):
    """A log that was read: where its parts lie."""

    parts: list[Path]
    source: LogSource


@task(
    name="read log",
    task_run_name="read {path}",
    cache_policy=NO_CACHE,
    retries=RETRIES,
    retry_delay_seconds=DELAYS_S,
    retry_condition_fn=storage_failed,
)
def read_log_into(folder: Path, path: str | os.PathLike[str]) -> ReadLog:
    """Read one log into parts of bounded size, and say where they are.

    Each holds `exposures`, `states`, `cameras` and `rejects` as `LogPart` has them.

    Raises
    ------
    LogError
        Where it is no log; see `read_log_parts`.
    """
    parts, source, n_frames = [], None, 0
    for number, part in enumerate(read_log_parts(path)):
        where = folder / f"part-{number}"
        write_part(
            where,
            {
                "exposures": part.exposures,
                "states": part.states,
                "cameras": part.cameras,
                "rejects": part.rejects,
            },
        )
        parts.append(where)
        n_frames += part.exposures.num_rows
        source = part.source or source
    assert source is not None, "the last part has it"
    LOGGER.info("%s: read %d frames in %d parts", source.name, n_frames, len(parts))
    return ReadLog(parts, source)

"""The night that a run is asked for; Prefect checks it before it creates a run."""

import datetime
from typing import Annotated, Any

from prefect.runtime import flow_run
from pydantic import Field

from epipole.schemas.errors import EpipoleError
from epipole.schemas.text.shown import as_line

YESTERDAY = "yesterday"
LONGEST_NAME = 60  # of a log in a run's name

Night = Annotated[str | None, Field(pattern=rf"^(\d{{4}}-\d\d-\d\d|{YESTERDAY})$")]


def night_asked(night: str | None) -> str | None:
    """Return the UTC date that is asked for; None: every night.

    Yesterday is the day before the run was scheduled, even if the run starts late.

    Raises
    ------
    EpipoleError
        If there is no such date.
    """
    if night is None:
        return None
    if night == YESTERDAY:
        due: datetime.datetime = flow_run.scheduled_start_time
        return (due.astimezone(datetime.UTC).date() - datetime.timedelta(days=1)).isoformat()
    try:
        return datetime.date.fromisoformat(night).isoformat()
    except ValueError as error:
        raise EpipoleError(f"night {night}: no such date; give one such as 2019-04-01") from error


def run_name() -> str:
    """Return the name of a run on Prefect's page, such as ``night 2019-04-01``."""
    asked: dict[str, Any] = flow_run.parameters
    try:
        night = night_asked(asked.get("night"))
    except EpipoleError:  # the run itself reports it
        night = asked["night"]
    return f"night {night}" if night else f"all nights of {_what(asked.get('logs'))}"


def _what(logs: Any) -> str:
    """Return what the logs are called: the name of the only one, or how many were given."""
    named = [logs] if isinstance(logs, str) else list(logs or ())
    if len(named) != 1:
        return f"{len(named)} logs"
    return as_line(named[0].rstrip("/").rpartition("/")[2] or named[0], LONGEST_NAME)

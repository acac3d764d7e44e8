"""Runs of a deployment that wait for the one that is running: the nights that they ask for.

A deployment makes one night at a time, and Prefect starts those that wait in any order. Objects are
followed from night to night, so the run that has begun makes earlier nights that wait first; the
runs that asked for them then find them unchanged.
"""

import datetime
import logging
from typing import Any

import httpx
from prefect.client.orchestration import get_client
from prefect.client.schemas.filters import FlowRunFilter
from prefect.exceptions import PrefectException
from prefect.runtime import deployment, flow_run

from epipole.schemas.dates import YESTERDAY, is_night, nights_before

LOGGER = logging.getLogger(__name__)


def waiting_nights() -> set[str]:
    """Return the nights that due runs of this deployment ask for, of the same logs and dataset.

    Empty outside a deployment, and where the server does not answer.
    """
    if deployment.id is None:
        return set()
    due = {"before_": datetime.datetime.now(datetime.UTC)}
    wanted = FlowRunFilter.model_validate(
        {
            "deployment_id": {"any_": [deployment.id]},
            "state": {"type": {"any_": ["SCHEDULED"]}},
            "expected_start_time": due,
        }
    )
    try:
        with get_client(sync_client=True) as client:
            mine = client.read_flow_run(flow_run.id).parameters
            runs = client.read_flow_runs(flow_run_filter=wanted)
    except (httpx.HTTPError, PrefectException) as error:
        LOGGER.warning("which nights wait is not known: %s", " ".join(str(error).split()))
        return set()
    nights = {
        _night(run.parameters.get("night"), run.expected_start_time)
        for run in runs
        if _but_night(run.parameters) == _but_night(mine)
    }
    return {night for night in nights if night is not None}


def _but_night(parameters: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in parameters.items() if name != "night"}


def _night(asked: object, due: datetime.datetime | None) -> str | None:
    """Return the night that a run asks for; None: not a single one."""
    if asked == YESTERDAY and due is not None:
        (night,) = nights_before(due.astimezone(datetime.UTC).date().isoformat(), 1)
        return night
    return asked if isinstance(asked, str) and is_night(asked) else None

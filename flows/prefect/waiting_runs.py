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

from epipole.schemas.dates import YESTERDAY, ends_of, is_night, nights_before, nights_from

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
    return {
        night
        for run in runs
        if _but_night(run.parameters) == _but_night(mine)
        for night in _nights(run.parameters.get("night"), run.expected_start_time)
    }


def _but_night(parameters: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in parameters.items() if name != "night"}


def _nights(asked: object, due: datetime.datetime | None) -> list[str]:
    """Return the nights that a run asks for; none if it asks for all that its logs have."""
    if asked == YESTERDAY and due is not None:
        return nights_before(due.astimezone(datetime.UTC).date().isoformat(), 1)
    ends = ends_of(asked) if isinstance(asked, str) else ("", "")
    return nights_from(*ends) if all(is_night(end) for end in ends) else []

"""Nights that other runs of a deployment wait for."""

import contextlib
import datetime
import uuid
from types import SimpleNamespace

import httpx
import pytest

from epipole.flows.prefect import waiting_runs
from epipole.flows.prefect.waiting_runs import waiting_nights

DUE = datetime.datetime(2019, 4, 3, 6, tzinfo=datetime.UTC)
MINE = {"logs": "/logs", "out": "/out", "night": "2019-04-05"}


class Client:
    """A server with these runs; the first one asks."""

    def __init__(self, *parameters: dict) -> None:
        self.runs = [SimpleNamespace(parameters=p, expected_start_time=DUE) for p in parameters]

    def read_flow_run(self, run_id):
        return self.runs[0]

    def read_flow_runs(self, flow_run_filter):
        assert flow_run_filter.deployment_id.any_ == [DEPLOYMENT]
        return self.runs[1:]


DEPLOYMENT = uuid.uuid4()


@pytest.fixture
def deployed(monkeypatch):
    """Return a function that says which runs a server has."""
    monkeypatch.setattr(waiting_runs, "deployment", SimpleNamespace(id=str(DEPLOYMENT)))
    monkeypatch.setattr(waiting_runs, "flow_run", SimpleNamespace(id="me"))

    def serve(client):
        monkeypatch.setattr(
            waiting_runs, "get_client", lambda sync_client: contextlib.nullcontext(client)
        )

    return serve


def test_the_nights_of_runs_that_ask_for_the_same(deployed):
    others = [
        MINE | {"night": "2019-04-04"}, MINE | {"night": "yesterday"}, MINE | {"night": None},
        MINE | {"night": "../x"}, MINE | {"night": "2019-04-05/2019-04-06"},
        MINE | {"night": "2019-04-01", "out": "/other"},
    ]  # fmt: skip
    deployed(Client(MINE, *others))
    assert waiting_nights() == {
        "2019-04-02", "2019-04-04", "2019-04-05", "2019-04-06"
    }  # fmt: skip


def test_none_without_a_deployment_or_an_answer(deployed, caplog):
    class Gone(Client):
        def read_flow_run(self, run_id):
            raise httpx.ConnectError("gone")

    deployed(Gone(MINE))
    assert waiting_nights() == set()
    assert "which nights wait is not known: gone" in caplog.text
    waiting_runs.deployment.id = None
    assert waiting_nights() == set()

"""What Prefect's page shows of a run: its name, lines of log, artifacts, how it ended."""

import json

import pytest
from prefect.client.orchestration import get_client
from prefect.logging.handlers import APILogHandler

from epipole.flows.night.progress import ROOT, STEPS
from epipole.flows.nightly import nightly
from epipole.flows.prefect import artifacts
from epipole.flows.prefect.page import shown_on_page


@pytest.fixture(scope="module")
def page(prefect, night_log, tmp_path_factory):
    """Return a function that asks Prefect's API about the run of one night."""
    out = tmp_path_factory.mktemp("page") / "out"
    with get_client(sync_client=True) as client:
        state = nightly([str(night_log)], str(out), return_state=True)
        run_id = str(state.state_details.flow_run_id)
        APILogHandler().flush()

        def ask(what: str) -> list[dict]:
            found = []
            while True:
                asked = {"flow_runs": {"id": {"any_": [run_id]}}, "offset": len(found)}
                if what == "logs":
                    asked = {"logs": {"flow_run_id": {"any_": [run_id]}}, "offset": len(found)}
                rows = client.request("POST", f"/{what}/filter", json=asked).json()
                found += rows
                if not rows:
                    return found

        yield ask


def test_the_run_has_its_lines_of_log_with_counts(page):
    lines = page("logs")
    of_flow = [line["message"] for line in lines if line["task_run_id"] is None]
    of_tasks = [line["message"] for line in lines if line["task_run_id"] is not None]
    assert "identified 240 of 240 frames by" in "\n".join(of_flow)
    assert "sat3: identified 60 of 60 frames" in "\n".join(of_tasks)


def test_the_run_is_named_and_has_its_artifacts(page):
    (run,) = page("flow_runs")
    assert run["name"].startswith("all nights of ")
    shown = {artifact["key"]: artifact for artifact in page("artifacts")}
    assert set(shown) == {"progress", "night", "sensors"}
    assert shown["progress"]["data"] == 100
    assert shown["progress"]["description"] == "done"
    assert "| objects | 9 |" in shown["night"]["data"]
    sensors = json.loads(shown["sensors"]["data"])
    assert [row["sensor"] for row in sensors] == ["sat1", "sat2", "sat3", "sat4"]
    assert [row["frames"] for row in sensors] == [60] * 4
    assert all(row["identified"] > 50 and row["tracks"] == 9 for row in sensors)
    assert all(0.05 < float(row["residual px"]) < 0.5 for row in sensors)
    assert all(0.9 < float(row["longest gap s"]) < 10 for row in sensors)
    assert "night=2019-04-01" in shown["night"]["data"]
    assert run["state"]["message"].startswith("9 objects, ")
    assert "240 of 240 frames identified" in run["state"]["message"]


def test_a_run_that_fails_says_so_and_leaves_no_handler(monkeypatch):
    shown = []
    monkeypatch.setattr(artifacts, "create_progress_artifact", lambda *_: "an id")
    monkeypatch.setattr(artifacts, "update_progress_artifact", lambda *a: shown.append(a))
    before = [*ROOT.handlers], [*STEPS.handlers], ROOT.level

    @shown_on_page
    def failing():
        raise ValueError("no")

    with pytest.raises(ValueError, match="no"):
        failing()
    assert shown[-1][2] == "failed; see the log"
    assert ([*ROOT.handlers], [*STEPS.handlers], ROOT.level) == before

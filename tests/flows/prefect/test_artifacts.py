"""Artifacts of a night on Prefect's page, and a page that cannot be written."""

import json
import logging
import re

import httpx
import pytest
from prefect.client.orchestration import get_client
from prefect.logging.handlers import APILogHandler

from epipole.flows.night.progress import ROOT, STEPS, step
from epipole.flows.night.summary import Summary
from epipole.flows.nightly import nightly
from epipole.flows.prefect import artifacts
from epipole.flows.prefect.artifacts import ProgressBar, as_markdown, show_summary, shown_on_page
from epipole.schemas.errors import LogError
from epipole.schemas.rejects import Reason
from epipole.schemas.stages import Stage
from epipole.tasks.report.frame_series import Gap
from epipole.tasks.report.night_facts import PagePicture, ReportExtract

FOUND = {
    "dataset": "/data/out", "nights": ["2019-04-01"], "logs": 2, "sensors": 1, "frames": 1234,
    "identified": 1200, "stars": 9, "detections": 8, "tracklets": 7, "outcomes": {"object": 7},
    "epochs": 6, "objects": 5, "verdicts": {"blended": 2, "sound": 3},
    "positions": 4, "rejects": {"no_state": 34, "bad_sigma": 1}, "mistakes": [], "faults": [],
    "by_sensor": [],
    "names": {}, "tracklet_names": {}, "residuals": [], "unchanged": False, "extracts": (),
}  # fmt: skip


def test_the_page_of_a_night_has_its_counts_and_what_was_left_out_by_reason():
    page = as_markdown(Summary(**FOUND))
    assert "# Night 2019-04-01" in page
    assert "| frames | 1,234 |" in page
    assert "| objects blended | 2 |" in page
    assert "sound" not in page
    assert "Left out: 35 things" in page
    no_state, bad_sigma = Reason.NO_STATE, Reason.BAD_SIGMA
    rows = f"| no_state | 34 | {no_state.sentence} |\n| bad_sigma | 1 | {bad_sigma.sentence} |"
    assert rows in page
    assert "not made again" not in page
    assert "- /data/out/night=2019-04-01" in page


def test_the_page_of_an_unchanged_night_says_that_it_was_not_made_again():
    assert "not made again" in as_markdown(Summary(**FOUND | {"unchanged": True}))


def test_the_page_of_a_night_has_pictures_and_the_gaps_of_sensors():
    gaps = (Gap("a|b", 0, 7_000_000_000), Gap("a|b", 9_000_000_000, 12_000_000_000))
    pictures = (PagePicture("Coverage", b"\x89PNG"),)
    extract = ReportExtract("2019-04-01", pictures, gaps, {"a|b": 10.0})
    page = as_markdown(Summary(**FOUND | {"extracts": (extract,)}))
    assert "![Coverage](data:image/png;base64,iVBORw==)" in page
    assert "| a&#124;b | 2 | 10 |" in page
    assert "extracts" not in Summary(**FOUND | {"extracts": (extract,)}).as_dict()


def test_progress_only_grows_though_a_stage_is_done_again(monkeypatch):
    percents = []
    monkeypatch.setattr(artifacts, "create_progress_artifact", lambda *_: "an id")
    monkeypatch.setattr(artifacts, "update_progress_artifact", lambda _, p, __: percents.append(p))
    monkeypatch.setattr(artifacts, "UPDATED_EVERY_S", 0.0)
    bar = ProgressBar()
    STEPS.addHandler(bar)
    stages = (Stage.READ, Stage.IDENTIFY, Stage.CALIBRATE, Stage.IDENTIFY, Stage.SOLVE)
    try:
        for stage in (*stages, Stage.PUBLISH):
            for done in range(4):
                step(stage, done, 3)
        step(Stage.TRACK, 0, 0)  # no sensor can take part
    finally:
        STEPS.removeHandler(bar)
    assert percents == sorted(percents)
    assert len(set(percents)) > 12
    assert 0 <= percents[0] < percents[-1] <= 100


def test_a_page_that_cannot_be_written_is_one_warning_and_no_failure(monkeypatch, caplog):
    def refused(*_, **__):
        raise httpx.ConnectError("connection refused")

    for name in ("progress", "markdown", "table"):
        monkeypatch.setattr(artifacts, f"create_{name}_artifact", refused)
    monkeypatch.setattr(artifacts, "update_progress_artifact", refused)
    bar = ProgressBar()
    bar.finish("done")
    show_summary(Summary(**FOUND))
    assert [record.levelname for record in caplog.records] == ["WARNING", "WARNING"]
    assert "the summary could not be shown on Prefect's page: connection refused" in caplog.text


def test_a_page_that_fails_in_the_middle_is_not_asked_again(monkeypatch, caplog):
    asked = []

    def refused(*arguments):
        asked.append(arguments)
        raise httpx.ConnectError("connection refused")

    monkeypatch.setattr(artifacts, "create_progress_artifact", lambda *_: "an id")
    monkeypatch.setattr(artifacts, "update_progress_artifact", refused)
    monkeypatch.setattr(artifacts, "UPDATED_EVERY_S", 0.0)
    bar = ProgressBar()
    STEPS.addHandler(bar)
    try:
        for done in range(3):
            step(Stage.IDENTIFY, done, 3)
    finally:
        STEPS.removeHandler(bar)
    assert len(asked) == 1
    assert caplog.text.count("could not be shown") == 1


def test_names_from_a_log_are_no_markdown():
    fault = "<img src=x>\n\n# [a](https://b.c)|"
    page = as_markdown(Summary(**FOUND | {"faults": [fault]}))
    (line,) = [line for line in page.splitlines() if "img" in line]
    assert line.startswith("- &#60;img src=x&#62;")
    assert not set(line.replace("&#", "")) & set("<>[]|#:")


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
    assert any(re.match(r"sat3 .*: identified 60 of 60 frames", line) for line in of_tasks)


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


def test_an_error_that_a_user_can_put_right_is_one_line_of_the_log(prefect, tmp_path, caplog):
    state = nightly(str(tmp_path / "none.mcap"), str(tmp_path / "out"), return_state=True)
    assert state.is_failed()
    assert state.message.endswith("none.mcap: no such file; check the path")
    lines = [record for record in caplog.records if record.name == "prefect.flow_runs"]
    assert not [record for record in lines if record.exc_info]
    assert sum("no such file" in record.getMessage() for record in lines) == 1
    for name in ("prefect.engine", "prefect.flow_runs"):
        for error, seen in ((LogError("x"), 0), (RuntimeError("x"), 1)):
            caplog.clear()
            said = "Engine execution exited with unexpected exception"
            logging.getLogger(name).error(said, exc_info=(type(error), error, None))
            assert len([record for record in caplog.records if record.name == name]) == seen

"""Artifacts of a night on Prefect's page, and a page that cannot be written."""

import httpx

from epipole.flows.night.progress import STEPS, step
from epipole.flows.night.summary import Summary
from epipole.flows.prefect import artifacts
from epipole.flows.prefect.artifacts import ProgressBar, as_markdown, show_summary
from epipole.schemas.rejects import Reason
from epipole.schemas.stages import Stage
from epipole.tasks.report.frame_series import Gap
from epipole.tasks.report.report_extract import PagePicture, ReportExtract

FOUND = {
    "dataset": "/data/out", "nights": ["2019-04-01"], "logs": 2, "sensors": 1, "frames": 1234,
    "identified": 1200, "stars": 9, "detections": 8, "tracklets": 7, "epochs": 6, "objects": 5,
    "positions": 4, "rejects": {"no_state": 34, "bad_sigma": 1}, "faults": [], "by_sensor": [],
    "names": {}, "residuals": [], "unchanged": False, "extracts": (),
}  # fmt: skip


def test_the_page_of_a_night_has_its_counts_and_what_was_left_out_by_reason():
    page = as_markdown(Summary(**FOUND))
    assert "# Night 2019-04-01" in page
    assert "| frames | 1,234 |" in page
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

"""Records of runs: how the last run of each night ended, what needs a look, and metrics."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from scenes.associations import filled
from typer.testing import CliRunner

from epipole.flows import nightly as flow
from epipole.flows.command_line.main import app
from epipole.flows.night.run_records import Stopwatch, read_records, write_record
from epipole.flows.night.summary import Summary, summarise
from epipole.io.datasets.night_tables import write_table
from epipole.schemas.errors import DatasetError, NoFramesError
from epipole.schemas.run_record import RunState
from epipole.schemas.settings import Settings
from epipole.schemas.tables import TABLES

NIGHT, NEXT = "2019-04-01", "2019-04-02"
LOOKS = ["a: no frames in the whole night"]


def published(dataset: Path, frames: dict[str, int]) -> Summary:
    """Make a dataset of nights, whose tables `nights` say how many frames they have."""
    for night, count in frames.items():
        for name, schema in TABLES.items():
            values = {"frames": [count]} if name == "nights" else {}
            rows = filled(schema, len(values), values)
            write_table(dataset / f"night={night}", name, [rows])
    return summarise(str(dataset), {night: dataset / f"night={night}" for night in frames})


def order(dataset: Path) -> flow.Order:
    return flow.Order(["log"], str(dataset), Settings(), None, False, False, {})


def test_the_metrics_of_a_night_are_its_counts(tmp_path, monkeypatch):
    both = replace(published(tmp_path, {NIGHT: 3, NEXT: 4}), frames=7)
    monkeypatch.setattr(flow, "make_nights", lambda *_: both)
    flow.make_and_record(order(tmp_path), None)
    metrics = (tmp_path / "runs" / "last.prom").read_text()
    assert f'epipole_night_frames{{night="{NEXT}"}} 4\n' in metrics


def test_a_run_that_publishes_nothing_leaves_what_needs_a_look(tmp_path, monkeypatch):
    made = replace(published(tmp_path, {NIGHT: 3}), looks={NIGHT: LOOKS})
    failed, empty = DatasetError("the disk is full"), NoFramesError("no log of the night")
    ends = iter([made, failed, empty, replace(made, unchanged=True, looks={})])

    def make(*_):
        end = next(ends)
        if isinstance(end, Exception):
            raise end
        return end

    def record() -> tuple[str, list[str]]:
        (found,) = read_records(str(tmp_path)).values()
        return found["state"], found["needs_look"]

    monkeypatch.setattr(flow, "make_nights", make)
    flow.make_and_record(order(tmp_path), NIGHT)
    assert record() == ("made", LOOKS)
    for error, state in ((DatasetError, "failed"), (NoFramesError, "no frames")):
        with pytest.raises(error):
            flow.make_and_record(order(tmp_path), NIGHT)
        assert record() == (state, LOOKS)
    assert flow.make_and_record(order(tmp_path), NIGHT).looks == {NIGHT: LOOKS}
    assert record() == ("made", LOOKS)


def test_the_command_line_records_that_an_unchanged_night_is_made(
    night_log, night_dataset, tmp_path, no_early_server
):
    out = str(shutil.copytree(night_dataset, tmp_path / "out"))
    write_record(out, NIGHT, RunState.FAILED, "the disk is full", Stopwatch.start(), Settings())
    ended = CliRunner().invoke(app, ["run", str(night_log), "--out", out, "--night", NIGHT])
    assert "unchanged" in ended.stdout, ended.output
    assert read_records(out)[NIGHT]["state"] == "made"

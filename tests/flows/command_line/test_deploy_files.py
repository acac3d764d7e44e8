"""The files of a deployment: written as they are in the package, and valid for who reads them."""

import configparser
import datetime
import fnmatch
import os
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
from prefect.events.schemas.automations import AutomationCore
from prefect.settings.models.root import Settings as SettingsRoot
from typer.testing import CliRunner

from epipole.flows.command_line.main import app
from epipole.flows.command_line.tools import FILES

ROOT = Path(__file__).parents[3]


@pytest.fixture
def written(tmp_path):
    ended = CliRunner().invoke(app, ["deploy-files", "--out", str(tmp_path / "new")])
    assert ended.exit_code == 0, ended.output
    return tmp_path / "new"


def test_all_files_are_written_and_none_is_replaced_unasked(written):
    assert sorted(path.name for path in written.iterdir()) == sorted(FILES)
    changed = written / "prefect.yaml"
    changed.write_text("mine")
    again = CliRunner().invoke(app, ["deploy-files", "--out", str(written)])
    assert again.exit_code == 1
    assert changed.read_text() == "mine"
    forced = CliRunner().invoke(app, ["deploy-files", "--out", str(written), "--force"])
    assert forced.exit_code == 0
    assert changed.read_text() != "mine"


def test_the_deployment_at_the_top_of_the_repository_is_the_same(written):
    assert (ROOT / "prefect.yaml").read_text() == (written / "prefect.yaml").read_text()


def test_there_is_a_deployment_for_earlier_nights_without_a_schedule(written):
    nightly, backfill = yaml.safe_load((written / "prefect.yaml").read_text())["deployments"]
    assert (nightly.pop("name"), backfill.pop("name")) == ("nightly", "backfill")
    assert nightly.pop("description") != backfill.pop("description")
    assert nightly.pop("schedules")
    assert nightly == backfill


def test_prefect_understands_the_automations(written):
    held = yaml.safe_load((written / "automations.yaml").read_text())["automations"]
    made = [AutomationCore.model_validate(automation) for automation in held]
    assert [
        getattr(automation.actions[0], "state", automation.actions[0].type) for automation in made
    ] == ["CRASHED", "CRASHED", "SCHEDULED", "FAILED", *["do-nothing"] * 3]
    deployed = yaml.safe_load((written / "prefect.yaml").read_text())["deployments"][0]
    beats_s = int(
        deployed["work_pool"]["job_variables"]["env"]["PREFECT_FLOWS_HEARTBEAT_FREQUENCY"]
    )
    assert made[0].trigger.within.total_seconds() >= 6 * beats_s
    for lost in made[:2]:  # a run that shows signs of life is not lost
        assert "prefect.flow-run.heartbeat" in lost.trigger.expect


def told_by(automation, event: str, run_count: int) -> bool:
    """Return whether an event of a run alone makes an automation act."""
    trigger = automation.trigger
    counts = trigger.match.root.get("prefect.run-count", "*")
    negated = counts.startswith("!")
    fits = fnmatch.fnmatchcase(str(run_count), counts.removeprefix("!")) != negated
    return trigger.posture.value == "Reactive" and event in trigger.expect and fits


@pytest.mark.parametrize("run_count", range(12))
def test_a_crashed_run_is_made_again_or_has_failed_and_is_told_once(written, run_count):
    held = yaml.safe_load((written / "automations.yaml").read_text())["automations"]
    made = [AutomationCore.model_validate(automation) for automation in held]

    def acts(event: str) -> list[str]:
        fired = [each.actions[0] for each in made if told_by(each, event, run_count)]
        return [getattr(action, "state", action.type) for action in fired]

    assert acts("prefect.flow-run.Crashed") == (["SCHEDULED"] if run_count < 4 else ["FAILED"])
    assert acts("prefect.flow-run.Failed") == ["do-nothing"]
    assert acts("prefect.flow-run.AwaitingRetry") == []
    for automation in made[-3:]:  # those that tell somebody: once of a run
        assert automation.trigger.for_each == {"prefect.resource.id"}
        assert automation.trigger.within.total_seconds() >= 3600


def test_the_secret_is_new_each_time_and_its_owners_only(written, tmp_path):
    old = os.umask(0o000)
    try:
        CliRunner().invoke(app, ["deploy-files", "--out", str(tmp_path / "other")])
    finally:
        os.umask(old)
    settings = [
        dict(
            line.split("=", 1)
            for line in (folder / "prefect.env").read_text().splitlines()
            if not line.startswith("#")
        )
        for folder in (written, tmp_path / "other")
    ]
    for own in settings:
        secret = own["PREFECT_SERVER_API_AUTH_STRING"]
        assert secret == own["PREFECT_API_AUTH_STRING"]
        assert len(secret.removeprefix("epipole:").rstrip("-")) >= 40  # 43 make 256 bits
        assert secret.endswith("-" * 25)  # what a server may write to its log
    assert settings[0] != settings[1]
    assert (tmp_path / "other" / "prefect.env").stat().st_mode & 0o777 == 0o600
    for file in (tmp_path / "other").iterdir():
        if file.name != "prefect.env":
            assert secret.split(":")[1] not in file.read_text()


def test_a_link_in_the_place_of_a_file_is_replaced_and_not_followed(written, tmp_path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.write_text("another's")
    (written / "prefect.env").unlink()
    (written / "prefect.env").symlink_to(elsewhere)
    forced = CliRunner().invoke(app, ["deploy-files", "--out", str(written), "--force"])
    assert forced.exit_code == 0
    assert elsewhere.read_text() == "another's"
    assert not (written / "prefect.env").is_symlink()


@pytest.mark.parametrize("name", ["epipole-server.service", "epipole-worker.service"])
def test_units_have_what_systemd_needs(written, name):
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str
    unit.read(written / name)
    assert unit["Service"]["ExecStart"].startswith("/opt/epipole/bin/prefect ")
    assert unit["Service"]["EnvironmentFile"] == "/etc/epipole/prefect.env"
    assert "SECRET" not in (written / name).read_text()
    assert unit["Service"]["Restart"] == "always"
    assert unit["Install"]["WantedBy"] == "multi-user.target"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="needs systemd-analyze")
def test_systemd_finds_no_fault_in_the_units(written):
    for unit in written.glob("*.service"):
        text = unit.read_text().replace("/opt/epipole/bin/prefect", "/bin/true")
        unit.write_text(text.replace("User=epipole", "User=root"))
    units = [str(unit) for unit in written.glob("*.service")]
    said = subprocess.run(["systemd-analyze", "verify", *units], capture_output=True, text=True)
    ours = [line for line in said.stderr.splitlines() if "epipole" in line]
    assert ours == []


def test_the_server_forgets_runs_after_a_quarter(written, monkeypatch):
    for line in (written / "prefect.env").read_text().splitlines():
        if "DB_VACUUM" in line:
            monkeypatch.setenv(*line.split("=", 1))
    vacuum = SettingsRoot().server.services.db_vacuum
    assert vacuum.enabled_vacuum_types == {"events", "flow_runs", "orphans"}
    assert vacuum.retention_period == datetime.timedelta(days=90)

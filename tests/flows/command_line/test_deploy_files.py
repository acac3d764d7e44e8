"""The files of a deployment: written as they are in the package, and valid for who reads them."""

import configparser
import shutil
import subprocess
from pathlib import Path

import pytest
import yaml
from prefect.events.schemas.automations import AutomationCore
from typer.testing import CliRunner

from epipole.flows.command_line.commands.deploy_files import FILES
from epipole.flows.command_line.main import app

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


def test_prefect_understands_the_automations(written):
    held = yaml.safe_load((written / "automations.yaml").read_text())["automations"]
    made = [AutomationCore.model_validate(automation) for automation in held]
    assert [automation.actions[0].type for automation in made] == [
        "change-flow-run-state", "do-nothing", "do-nothing",
    ]  # fmt: skip
    deployed = yaml.safe_load((written / "prefect.yaml").read_text())["deployments"][0]
    beats_s = int(
        deployed["work_pool"]["job_variables"]["env"]["PREFECT_FLOWS_HEARTBEAT_FREQUENCY"]
    )
    assert made[0].trigger.within.total_seconds() >= 3 * beats_s


@pytest.mark.parametrize("name", ["epipole-server.service", "epipole-worker.service"])
def test_units_have_what_systemd_needs(written, name):
    unit = configparser.ConfigParser(strict=False, interpolation=None)
    unit.optionxform = str
    unit.read(written / name)
    assert unit["Service"]["ExecStart"].startswith("/opt/epipole/bin/prefect ")
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

"""The example that writes a log from arrays: its log is valid."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLE = Path(__file__).parents[2] / "examples" / "write_log.py"


def run(*command, folder):
    return subprocess.run(command, check=True, capture_output=True, text=True, cwd=folder).stdout


@pytest.mark.long
def test_the_log_is_what_info_finds(tmp_path):
    said = run(sys.executable, EXAMPLE, "my.mcap", folder=tmp_path)
    assert said.splitlines() == ["my.mcap: 240 frames, 260 states", "nothing was left out"]
    program = Path(sys.executable).with_name("epipole")
    (found,) = json.loads(run(program, "info", "my.mcap", "--json", folder=tmp_path))
    assert found["left_out"] == []
    assert [sensor["sensor_id"] for sensor in found["sensors"]] == ["sat1", "sat2", "sat3", "sat4"]
    sensor = found["sensors"][0]
    assert (sensor["frames"], sensor["states"], sensor["states_with_velocity"]) == (60, 65, 65)
    assert sensor["image_px"] == [512, 512]
    ran = run(program, "run", "my.mcap", "--out", "out", "--quiet", "--json", folder=tmp_path)
    assert (json.loads(ran)["identified"], json.loads(ran)["objects"]) == (240, 9)

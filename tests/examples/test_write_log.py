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
    assert said.splitlines() == ["my.mcap: 30 frames, 6 states", "nothing was left out"]
    program = Path(sys.executable).with_name("epipole")
    (found,) = json.loads(run(program, "info", "my.mcap", "--json", folder=tmp_path))
    (sensor,) = found["sensors"]
    assert found["left_out"] == []
    assert (sensor["sensor_id"], sensor["frames"], sensor["states"]) == ("sat1", 30, 6)
    assert sensor["rate_hz"] == 1.0
    assert sensor["image_px"] == [1024, 1024]
    assert sensor["states_with_velocity"] == 6
    assert all(abs(side - 8.0) < 1e-6 for side in sensor["field_deg"])

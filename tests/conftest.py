"""What tests share: an embedded Prefect of their own, and one simulated night."""

import os
import sys
import tempfile
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))  # helpers beside the tests: random_stars

# Before anything imports prefect: a developer's own Prefect neither sees these runs nor
# changes them.
_PREFECT_HOME = tempfile.TemporaryDirectory(prefix="epipole-prefect-")
os.environ["PREFECT_HOME"] = _PREFECT_HOME.name
_CACHE = tempfile.TemporaryDirectory(prefix="epipole-cache-")
os.environ["EPIPOLE_CACHE"] = _CACHE.name
for name in ("PREFECT_API_URL", "PREFECT_PROFILE"):
    os.environ.pop(name, None)


@pytest.fixture(scope="session")
def prefect():
    """Run flows on one embedded API for the whole session."""
    from epipole.flows.prefect_defaults import embedded_prefect, quiet_console

    quiet_console()
    with embedded_prefect():
        yield


@pytest.fixture(scope="session")
def night_log(tmp_path_factory) -> Path:
    """Return a log of four sensors and nine objects over a minute; its truth is beside it."""
    from epipole.flows.simulate import simulate

    log = tmp_path_factory.mktemp("night") / "night.mcap"
    simulate("four_sensor_geo", log, seed=7)
    return log


@pytest.fixture(scope="session")
def night_dataset(prefect, night_log, tmp_path_factory) -> Path:
    """Return the dataset of `night_log`."""
    from epipole.flows.nightly import nightly

    out = tmp_path_factory.mktemp("dataset") / "out"
    nightly([str(night_log)], str(out))
    return out

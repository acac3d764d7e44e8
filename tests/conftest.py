"""Fixtures of all tests: an embedded Prefect, one simulated night, an S3 server."""

import contextlib
import os
import socket
import subprocess
import sys
import tempfile
import time
import urllib.request
from pathlib import Path

import pytest

import epipole.tasks  # noqa: F401  before EPIPOLE_CACHE is set, so that kernels stay cached

sys.path.append(str(Path(__file__).parent))  # for the helpers in tests/scenes

ROOT = Path(__file__).parents[1]
START_S = 60  # longest start of the S3 server

# Before anything imports prefect: these runs must not use the Prefect of the developer.
_PREFECT_HOME = tempfile.TemporaryDirectory(prefix="epipole-prefect-")
os.environ["PREFECT_HOME"] = _PREFECT_HOME.name
_CACHE = tempfile.TemporaryDirectory(prefix="epipole-cache-")
os.environ["EPIPOLE_CACHE"] = _CACHE.name
for name in ("PREFECT_API_URL", "PREFECT_PROFILE"):
    os.environ.pop(name, None)


def pytest_collection_modifyitems(config, items):
    """Leave the long tests out, unless files or a marker are named: `pytest -m long` runs them."""
    if config.args_source is not pytest.Config.ArgsSource.TESTPATHS or config.getoption("-m"):
        return
    left_out = [item for item in items if item.get_closest_marker("long")]
    items[:] = [item for item in items if not item.get_closest_marker("long")]
    config.hook.pytest_deselected(items=left_out)


@pytest.fixture(scope="session")
def prefect():
    """Run flows on one embedded API for the whole session."""
    from epipole.flows.prefect.defaults import embedded_prefect, quiet_console

    quiet_console()
    with embedded_prefect():
        yield


@pytest.fixture(scope="session")
def night_log(tmp_path_factory) -> Path:
    """Return a log of four sensors and nine objects over a minute, with its truth beside it."""
    from epipole.flows.simulate import simulate

    log = tmp_path_factory.mktemp("night") / "night.mcap"
    simulate("four_sensor_geo", log, seed=7)
    return log


@pytest.fixture
def no_early_server(monkeypatch):
    """Keep `epipole run` in this process from launching Prefect's server before it is needed.

    Each start takes two seconds of CPU. These runs use the server of the session, or none.
    """
    from epipole.flows.command_line import run, run_nightly

    for module in (run, run_nightly):
        monkeypatch.setattr(module, "launch", lambda _: None)


@pytest.fixture(scope="session")
def night_run(prefect, night_log, tmp_path_factory):
    """Return the dataset of `night_log`, which tests only read, and the summary of its run."""
    from epipole.flows.nightly import nightly

    out = tmp_path_factory.mktemp("dataset") / "out"
    return out, nightly([str(night_log)], str(out))


@pytest.fixture(scope="session")
def night_dataset(night_run) -> Path:
    """Return the dataset of `night_log`, which tests only read."""
    return night_run[0]


@pytest.fixture(scope="session")
def example(prefect, tmp_path_factory) -> Path:
    """Return a folder that holds out/, made by the README's first command."""
    from epipole.flows.nightly import nightly

    folder = tmp_path_factory.mktemp("example")
    nightly([str(ROOT / "examples" / "four_sensor_geo.mcap")], str(folder / "out"))
    return folder


@pytest.fixture(scope="session")
def s3_server():
    """Run an S3 server on a free port, and return its address; skip where none is installed."""
    for package in ("moto", "flask", "s3fs"):
        pytest.importorskip(package)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(port)]
    server = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    address = f"http://127.0.0.1:{port}"
    try:
        for _ in range(10 * START_S):
            with contextlib.suppress(OSError):
                urllib.request.urlopen(address, timeout=1).close()
                break
            time.sleep(0.1)
        else:
            pytest.fail("the S3 server did not start")
        yield address
    finally:
        server.terminate()
        server.wait(10)


@pytest.fixture
def s3(s3_server, monkeypatch):
    """Direct s3:// to the server, as a user would, by environment variables."""
    import s3fs

    for name, value in {
        "AWS_ENDPOINT_URL": s3_server,
        "AWS_ACCESS_KEY_ID": "any",
        "AWS_SECRET_ACCESS_KEY": "any",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_CONFIG_FILE": os.devnull,
        "AWS_SHARED_CREDENTIALS_FILE": os.devnull,
        "AWS_EC2_METADATA_DISABLED": "true",
        "AWS_MAX_ATTEMPTS": "1",
    }.items():
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    storage = s3fs.S3FileSystem()
    for bucket in ("logs", "nights"):
        if not storage.exists(bucket):
            storage.mkdir(bucket)
    yield storage
    s3fs.S3FileSystem.clear_instance_cache()

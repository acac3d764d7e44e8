"""A night that gets more logs: only what they change is made again, with the rows of one run."""

import logging
import re
from pathlib import Path

import pytest
from scenes.dataset_tables import contents

from epipole.flows.nightly import nightly
from epipole.flows.simulate import simulate
from epipole.io.work.folder import work_root

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("prefect")]

NIGHT = "2019-04-01"
KEEP = {"work": {"keep": True}}
LOGS, HOURS = 12, 2.0  # ten minutes each


@pytest.fixture(scope="module")
def logs(tmp_path_factory) -> list[str]:
    """Return the logs of a night of two sensors and three objects, in order of time."""
    folder = tmp_path_factory.mktemp("logs")
    few = {"sensors": 2, "objects": 3, "hours": HOURS, "rate_hz": 0.05}
    simulate("night", folder / "n.mcap", logs=LOGS, seed=3, **few)
    return [str(folder / f"n-{k + 1}.mcap") for k in range(LOGS)]


@pytest.fixture(scope="module")
def at_once(logs, tmp_path_factory) -> dict:
    """Return the rows of all logs in one run."""
    out = tmp_path_factory.mktemp("at_once") / "out"
    nightly(logs, str(out))
    return contents(out / f"night={NIGHT}")


@pytest.mark.parametrize(("late", "share"), [(11, 0.3), (3, 0.05)])
def test_a_late_log_gives_the_rows_of_one_run(logs, at_once, late, share, tmp_path, caplog):
    out = str(tmp_path / "out")
    nightly([log for k, log in enumerate(logs) if k != late], out, KEEP)
    with caplog.at_level(logging.INFO):
        nightly(logs, out, KEEP)
    found = re.search(r"used (\d+) of (\d+) parts", caplog.text)
    assert found is not None
    used, kept = map(int, found.groups())
    assert used > share * kept
    assert contents(Path(out, f"night={NIGHT}")) == at_once
    assert [folder.name[:4] for folder in work_root(out).iterdir()] == ["kept"]

"""A run that is killed as it publishes: no half night, nothing left, then the same bytes.

A short round; the long one is `python tests/scenes/killed_runs.py`.
"""

import signal

import pytest
from scenes.dataset_tables import contents
from scenes.killed_runs import PUBLISHING, Stop, StoppedRuns, make_logs, without_report

pytestmark = pytest.mark.long

# The sixth change of a file: one night is in place, the other one is not.
BETWEEN_NIGHTS = Stop(signal.SIGKILL, write=6, mark=PUBLISHING)


def test_a_run_that_is_killed_between_two_nights_does_no_harm(prefect, tmp_path):
    from epipole.flows.nightly import nightly

    logs, whole = make_logs(tmp_path), []
    for number, log in enumerate(logs):
        out = tmp_path / f"whole-{number}"
        nightly([str(log)], str(out))
        whole.append(contents(out))
    runs = StoppedRuns(tmp_path, logs, whole, without_report(tmp_path))
    assert runs.stop(0, BETWEEN_NIGHTS) == "killed"
    runs.finish(1)

"""A few whole runs of damaged logs and of settings at their bounds; `whole_runs.py` has more."""

import pytest

from damage import odd_settings
from damage.whole_runs import run_of_case, run_of_setting

pytestmark = pytest.mark.long

NUMBERS = (4, 5, 6)
EVERY = 24  # of the settings at their bounds, one is run


@pytest.mark.parametrize("number", NUMBERS)
def test_a_run_of_a_damaged_log_is_published_or_refused(prefect, number, tmp_path):
    came = run_of_case(number, tmp_path)
    assert not came.fault, came.outcome


@pytest.mark.parametrize("extreme", odd_settings.extremes()[::EVERY], ids=str)
def test_a_run_with_a_setting_at_its_bound_is_published_or_refused(prefect, extreme, tmp_path):
    came = run_of_setting(*extreme, tmp_path)
    assert not came.fault, came.outcome

"""Storage that fails at random calls: one line, no half night, and the next run ends well.

A short round; the long one is `python tests/scenes/failing_storage.py`.
"""

import shutil
import subprocess
import sys

import pytest
from scenes import failing_storage

pytestmark = pytest.mark.long


@pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")
def test_storage_that_fails_at_any_call_is_one_line_and_no_half_night():
    command = [sys.executable, failing_storage.__file__, "--faults", "1"]
    run = subprocess.run(command, capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr

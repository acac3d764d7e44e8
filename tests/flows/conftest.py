"""Fixtures of the tests of flows."""

import pytest

from epipole.flows.night import reports


@pytest.fixture(scope="module", autouse=True)
def no_drawing(request):
    """Let runs in this process draw no report, which takes as long as all the rest of a short one.

    A module that is about reports says so: `DRAWS = True`.
    """
    with pytest.MonkeyPatch.context() as patch:
        if not getattr(request.module, "DRAWS", False):
            patch.setattr(reports, "_can_draw", lambda: False)
        yield

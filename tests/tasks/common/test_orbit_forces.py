"""Orbit forces: which satellites stay above the air."""

import numpy as np
import pytest

from epipole.tasks.algorithms.constants import GM_KM3_S2
from epipole.tasks.common.orbit_forces import is_sunlit


@pytest.mark.parametrize(
    ("radius_km", "other_km", "sunlit"),
    [
        (42_164.0, 42_164.0, True),
        (7_500.0, 7_500.0, True),
        (6_900.0, 6_900.0, False),
        (42_164.0, 6_700.0, False),  # at the apogee of a transfer orbit
        (6_700.0, 42_164.0, False),
    ],
)
def test_the_perigee_decides(radius_km, other_km, sunlit):
    speed = np.sqrt(GM_KM3_S2 * (2 / radius_km - 2 / (radius_km + other_km)))
    assert is_sunlit(np.array([radius_km, 0.0, 0.0, 0.0, speed, 0.0])) is sunlit

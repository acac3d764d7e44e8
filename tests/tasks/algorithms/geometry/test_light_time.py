"""Light time: each sensor sees an object where its light left for it."""

import numpy as np

from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.light_time import apparent_places


def test_a_far_sensor_sees_an_object_where_it_was_earlier():
    x, v = np.array([[7000.0, 0.0, 0.0]] * 2), np.array([[0.0, 7.5, 0.0]] * 2)
    r = np.array([[8000.0, 0.0, 0.0], [-35000.0, 0.0, 0.0]])
    light_s = np.full(2, 1000.0 / SPEED_OF_LIGHT_KM_S)  # where the near sensor sees it
    seen = apparent_places(x, v, light_s, r)
    np.testing.assert_allclose(seen[0], x[0], atol=1e-9)
    np.testing.assert_allclose(seen[1] - x[1], [0.0, -7.5 * 41000.0 / SPEED_OF_LIGHT_KM_S, 0.0])

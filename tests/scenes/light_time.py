"""A scene in which light time matters: sensors at very different ranges see a fast object."""

import numpy as np

from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.constants import ARCSEC, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import tangent_basis


def light_time_samples():
    """Two low sensors and a geostationary one see a low object, each where its light left it."""
    times = np.array([0.0, 15.0])
    r_0 = np.array([[7200.0, 0.0, 0.0], [6900.0, 900.0, 500.0], [30000.0, -29600.0, 0.0]])
    v = np.array([[0.0, 7.4, 0.5], [-1.0, 4.0, 6.3], [2.2, 2.2, 0.0]])
    x_0, v_x = np.array([7000.0, 300.0, 1500.0]), np.array([-1.0, -6.0, 4.4])

    def sight(t):
        r, delay = r_0 + v * t, np.zeros(3)
        for _ in range(4):
            away = x_0 + v_x * (t - delay)[:, None] - r
            delay = np.linalg.norm(away, axis=1) / SPEED_OF_LIGHT_KM_S
        return away / np.linalg.norm(away, axis=1, keepdims=True)

    u = np.stack([sight(t) for t in times], axis=1)
    rate = np.stack([(sight(t + 0.05) - sight(t - 0.05)) / 0.1 for t in times], axis=1)
    attitude = np.concatenate([tangent_basis(u), u[:, :, None]], axis=2)
    return Samples(
        sensor=np.arange(3),
        start_s=np.full(3, -1.0),
        end_s=np.full(3, 16.0),
        seen=np.ones((3, 2), bool),
        u=u,
        cov=np.tile(np.eye(2) * (0.3 * ARCSEC) ** 2, (3, 2, 1, 1)),
        sigma_km=np.full((3, 2), 0.02),
        time_s=times,
        sensor_km=r_0[:, None] + v[:, None] * times[:, None],
        R_sensor_from_icrs=attitude,
        half_field=np.full((3, 2), np.tan(np.radians(4.0))),
        rate=rate,
        sensor_km_s=np.repeat(v[:, None], 2, axis=1),
    )

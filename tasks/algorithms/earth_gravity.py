"""Gravity of the Earth, a point mass with its flattening, and motion under it over minutes.

Without all other forces the error is below 2 m after ten minutes of a low orbit, see
`orbits.forces` for these. The flattening (J2) is about the z axis of the GCRF, which is within 0.2
degrees of the pole in this century.

`gravity` and `propagate_states` are for many states at once, `advance` is for one, in kernels. Both
integrate by the classical method of Runge and Kutta, of fourth order.

References
----------
Vallado (2013), Fundamentals of Astrodynamics and Applications, eq. 8-30.
"""

import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM, GM_KM3_S2, J2
from epipole.tasks.algorithms.kernels import borrowing_kernel, kernel

LOWEST_ORBIT_KM = EARTH_RADIUS_KM + 80.0  # below, air or ground carries a vehicle: no free fall


def gravity(r_km: Array) -> Array:
    """Return the acceleration [km/s^2] of (..., 3) positions [km], GCRF.

    Zero below `LOWEST_ORBIT_KM`.
    """
    out = np.empty(r_km.shape)
    _pull(np.array(r_km, float, order="C").reshape(-1, 3), out.reshape(-1, 3))
    return out


@kernel
def _pull(r, out):
    """Write `gravity` at r (n, 3) [km] to `out` (n, 3)."""
    for i in range(len(r)):
        x, y, z = r[i, 0], r[i, 1], r[i, 2]
        r2, pull, across, along = _terms(x, y, z)
        pull = pull if r2 > LOWEST_ORBIT_KM**2 else 0.0
        out[i, 0], out[i, 1] = x * (-pull * across), y * (-pull * across)
        out[i, 2] = -pull * z * along


@borrowing_kernel
def _terms(x0, x1, x2):
    """Return the terms of gravity at a position [km], GCRF.

    The squared distance [km^2]; the pull of a point mass over the distance [1/s^2]; and the factors
    of the flattening on it, across the Earth's axis and along it.
    """
    r2 = x0 * x0 + x1 * x1 + x2 * x2
    oblate = 1.5 * J2 * EARTH_RADIUS_KM**2 / r2
    tilt = 5.0 * x2 * x2 / r2
    pull = GM_KM3_S2 / (r2 * np.sqrt(r2))
    return r2, pull, 1.0 + oblate * (1.0 - tilt), 1.0 + oblate * (3.0 - tilt)


def propagate_states(r_km: Array, v_km_s: Array, dt_s: Array, steps: int) -> tuple[Array, Array]:
    """Return positions and velocities after a time, each in the same number of steps.

    Parameters
    ----------
    r_km, v_km_s : (n, 3) float
        States, GCRF.
    dt_s : (n,) float
        Time of each [s]; one (1,) serves all.
    """
    h = (dt_s / steps)[:, None]
    r, v = r_km.copy(), v_km_s.copy()
    for _ in range(steps):
        v1, g1 = v, gravity(r)
        v2, g2 = v + h / 2 * g1, gravity(r + h / 2 * v1)
        v3, g3 = v + h / 2 * g2, gravity(r + h / 2 * v2)
        v4, g4 = v + h * g3, gravity(r + h * v3)
        r = r + h / 6 * (v1 + 2 * v2 + 2 * v3 + v4)
        v = v + h / 6 * (g1 + 2 * g2 + 2 * g3 + g4)
    return r, v


@kernel
def _rates(y, out):
    """Write the time derivatives of y to `out`, as in `advance`.

    y is (6,) or (42,); `out` may be longer, and its other elements stay.
    """
    x0, x1, x2 = y[0], y[1], y[2]
    r2, pull, across, along = _terms(x0, x1, x2)
    level = -pull * across
    out[0], out[1], out[2] = y[3], y[4], y[5]
    out[3], out[4] = x0 * level, x1 * level
    out[5] = -pull * x2 * along
    if len(y) == 6:
        return
    # The matrix neglects the oblateness: a thousandth of its elements.
    three = 3.0 * pull / r2
    for k in range(6):
        c0, c1, c2 = y[6 + k], y[12 + k], y[18 + k]
        out[6 + k], out[12 + k], out[18 + k] = y[24 + k], y[30 + k], y[36 + k]
        along = three * (x0 * c0 + x1 * c1 + x2 * c2)
        out[24 + k] = along * x0 - pull * c0
        out[30 + k] = along * x1 - pull * c1
        out[36 + k] = along * x2 - pull * c2


@kernel
def advance(y, dt_s, step_s, work):
    """Propagate y by dt_s [s] in place, in equal steps of at most step_s [s].

    y (6,) is a state [km, km/s], GCRF; or y (42,) the state and, row by row, the (6, 6) matrix of
    its derivatives by the state at the epoch. `work` (5, 42) is scratch; (5, 6) suffices for a
    state.
    """
    n = int(np.ceil(abs(dt_s) / step_s))
    if n == 0:
        return
    h = dt_s / n
    k1, k2, k3, k4, at = work[0], work[1], work[2], work[3], work[4]
    for _ in range(n):
        _rates(y, k1)
        for m in range(len(y)):
            at[m] = y[m] + 0.5 * h * k1[m]
        _rates(at[: len(y)], k2)
        for m in range(len(y)):
            at[m] = y[m] + 0.5 * h * k2[m]
        _rates(at[: len(y)], k3)
        for m in range(len(y)):
            at[m] = y[m] + h * k3[m]
        _rates(at[: len(y)], k4)
        for m in range(len(y)):
            y[m] += h / 6.0 * (k1[m] + 2.0 * k2[m] + 2.0 * k3[m] + k4[m])

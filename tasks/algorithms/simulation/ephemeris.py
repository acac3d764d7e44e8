"""Where the Earth is: barycentric position and velocity, quickly for many times."""

import erfa
import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.time.time_scales import AU_KM, DAY_S, tt_julian_date

Array = npt.NDArray[np.float64]
Nanoseconds = npt.NDArray[np.int64]

J2000_JD = 2451545.0
NODE_S = 1200  # a cubic between such nodes is right to 1e-6 km


def barycentric_julian_date(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return the two-part TDB Julian date of UTC nanoseconds since 1970."""
    jd1, jd2 = tt_julian_date(time_ns)
    g = np.radians(357.53 + 0.98560028 * (jd1 - J2000_JD + jd2))
    return jd1, jd2 + 0.001657 * np.sin(g) / DAY_S


def julian_years_since(epoch: float, time_ns: Nanoseconds) -> Array:
    """Return TDB Julian years since an epoch such as 1991.25, that of Hipparcos' places."""
    jd1, jd2 = barycentric_julian_date(time_ns)
    return ((jd1 - J2000_JD) + jd2) / 365.25 + (2000.0 - epoch)


def earth_at(time_ns: Nanoseconds) -> tuple[Array, Array]:
    """Return the Earth's barycentric positions [km] and velocities [km/s], (n, 3), ICRS axes.

    The series of IAU SOFA costs 20 microseconds a time, so it is taken at nodes of
    20 minutes with Hermite cubics between them.
    """
    seconds, rest = np.divmod(np.asarray(time_ns, np.int64), 1_000_000_000)
    if not len(seconds):
        return np.empty((0, 3)), np.empty((0, 3))
    first = int(seconds.min()) // NODE_S * NODE_S
    nodes = np.arange(first, int(seconds.max()) + NODE_S + 1, NODE_S)
    _, earth = erfa.epv00(*barycentric_julian_date(nodes * 1_000_000_000))
    p, v = earth["p"] * AU_KM, earth["v"] * (AU_KM / DAY_S)
    i = np.clip((seconds - first) // NODE_S, 0, len(nodes) - 2)
    u = (((seconds - nodes[i]) + rest * 1e-9) / NODE_S)[:, None]
    p0, p1, m0, m1 = p[i], p[i + 1], v[i] * NODE_S, v[i + 1] * NODE_S
    a, b = 2 * (p0 - p1) + m0 + m1, 3 * (p1 - p0) - 2 * m0 - m1
    return p0 + u * (m0 + u * (b + u * a)), (m0 + u * (2 * b + u * 3 * a)) / NODE_S

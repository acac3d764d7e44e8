"""Forces on a satellite: the Earth's gravity, Sun, Moon, sunlight and air.

The axes are those of a night: z along the Earth's pole, x to its origin of right ascension (CIRS),
both of one instant and kept. In a day the pole moves by 0.1 arcsec.
"""

from typing import NamedTuple

import erfa
import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.constants import (
    AU_KM,
    C22,
    DAY_S,
    EARTH_RADIUS_KM,
    EARTH_RATE_RAD_S,
    GM_KM3_S2,
    GM_MOON_KM3_S2,
    GM_SUN_KM3_S2,
    J2,
    J3,
    J4,
    S22,
    SECOND_NS,
    SUNLIGHT_PRESSURE_N_M2,
)
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.times import tt_julian_date, utc_julian_date

N_AREAS = 2  # areas over mass that are unknowns: in sunlight, in the air
N_UNKNOWNS = 6 + N_AREAS
NODE_S = 3600.0  # between the nodes of Sun and Moon: a cubic is right to 10 m
MARGIN_S = 2 * NODE_S
OBLATENESS = 1.0 / 298.257223563  # WGS 84

# Vallado (2013), table 8-4: base altitude [km], density [kg/m^3] and scale height [km] of a static
# atmosphere of mean solar activity. Real densities differ by a factor of up to three.
_AIR = np.array([
    [100, 5.297e-7, 5.877], [110, 9.661e-8, 7.263], [120, 2.438e-8, 9.473], [130, 8.484e-9, 12.636],
    [140, 3.845e-9, 16.149], [150, 2.070e-9, 22.523], [180, 5.464e-10, 29.740],
    [200, 2.789e-10, 37.105], [250, 7.248e-11, 45.546], [300, 2.418e-11, 53.628],
    [350, 9.518e-12, 53.298], [400, 3.725e-12, 58.515], [450, 1.585e-12, 60.828],
    [500, 6.967e-13, 63.822], [600, 1.454e-13, 71.835], [700, 3.614e-14, 88.667],
    [800, 1.170e-14, 124.64], [900, 5.245e-15, 181.05], [1000, 3.019e-15, 268.00],
])  # fmt: skip


class Surroundings(NamedTuple):
    """Sun, Moon and Earth around a night, for kernels. Times count from an origin [s].

    start_s, step_s : float
        Time of the first node, and between nodes.
    sun, moon : (m, 6) float
        Geocentric position [km] and velocity [km/s] at the nodes, in the axes of the night.
    R_night_from_gcrf : (3, 3) float
        Rotation to the axes of the night.
    era_rad : float
        Earth rotation angle at the origin.
    """

    start_s: float
    step_s: float
    sun: Array
    moon: Array
    R_night_from_gcrf: Array
    era_rad: float


def surroundings(
    origin_ns: int, first_ns: int, last_ns: int, ut1_utc_s: float = 0.0
) -> Surroundings:
    """Return what acts on satellites from a first to a last time, UTC since 1970 [ns].

    Parameters
    ----------
    origin_ns
        Time from which those in `Surroundings` count.
    ut1_utc_s
        UT1-UTC [s]. Without it longitudes are off by up to 14 arcsec.

    References
    ----------
    Sun: Bretagnon and Francou (1988), VSOP87, as in ERFA's epv00. Moon: Meeus (1998), as in ERFA's
    moon98; both are right to 20 km.
    """
    start_s = (first_ns - origin_ns) / SECOND_NS - MARGIN_S
    end_s = (last_ns - origin_ns) / SECOND_NS + MARGIN_S
    at_s = start_s + NODE_S * np.arange(int(np.ceil((end_s - start_s) / NODE_S)) + 1)
    jd = tt_julian_date(origin_ns + np.round(at_s * SECOND_NS).astype(np.int64))
    earth, moon = erfa.epv00(*jd)[0], erfa.moon98(*jd)
    middle = np.array([(first_ns + last_ns) // 2])
    R = erfa.c2i06a(*tt_julian_date(middle))[0]
    sun, moon = (
        np.concatenate([of["p"] @ R.T * AU_KM, of["v"] @ R.T * (AU_KM / DAY_S)], axis=1)
        for of in (earth, moon)
    )
    day, share = utc_julian_date(np.array([origin_ns]))
    era_rad = float(erfa.era00(day, share + ut1_utc_s / DAY_S)[0])
    return Surroundings(float(start_s), NODE_S, -sun, moon, np.ascontiguousarray(R), era_rad)


@kernel
def _at_time(nodes, start_s, step_s, t_s, out):
    """Write the position [km] of a body at a time to `out` (3,): a cubic between its nodes.

    `nodes` (m, 6) are `sun` or `moon` of `Surroundings`, with `start_s` and `step_s` of it.
    """
    k = min(max(int((t_s - start_s) / step_s), 0), len(nodes) - 2)
    u = (t_s - start_s) / step_s - k
    for a in range(3):
        p, q = nodes[k, a], nodes[k + 1, a]
        dp, dq = nodes[k, 3 + a] * step_s, nodes[k + 1, 3 + a] * step_s
        out[a] = (
            (1 + 2 * u) * (1 - u) ** 2 * p
            + u * (1 - u) ** 2 * dp
            + u * u * (3 - 2 * u) * q
            + u * u * (u - 1) * dq
        )


@kernel
def _add_earth(x, angle_rad, out):
    """Add the Earth's gravity at `x` to `out`: point mass, J2 to J4, C22 and S22.

    `x` (3,) [km] and `out` (3,) [km/s^2] are in the axes of the night, `angle_rad` is the Earth
    rotation angle.

    References
    ----------
    Montenbruck and Gill (2000), Satellite Orbits, section 3.2.
    """
    r2 = x[0] * x[0] + x[1] * x[1] + x[2] * x[2]
    r = np.sqrt(r2)
    s = x[2] / r
    q = EARTH_RADIUS_KM / r
    p2, d2 = 1.5 * s * s - 0.5, 3.0 * s
    p3, d3 = (2.5 * s * s - 1.5) * s, 7.5 * s * s - 1.5
    p4, d4 = (35.0 * s * s - 30.0) * s * s / 8.0 + 0.375, (17.5 * s * s - 7.5) * s
    f2, f3, f4 = J2 * q * q, J3 * q**3, J4 * q**4
    radial = -1.0 + f2 * (3 * p2 + s * d2) + f3 * (4 * p3 + s * d3) + f4 * (5 * p4 + s * d4)
    polar = -(f2 * d2 + f3 * d3 + f4 * d4)
    pull = GM_KM3_S2 / r2
    c, w = np.cos(2 * angle_rad), np.sin(2 * angle_rad)
    # The equator's ellipse turned with the Earth.
    even, odd = C22 * c - S22 * w, C22 * w + S22 * c
    unit_x, unit_y = x[0] / r, x[1] / r
    sector = even * (unit_x**2 - unit_y**2) + 2.0 * odd * unit_x * unit_y
    radial -= 15.0 * q * q * sector
    for a in range(3):
        out[a] += pull * radial * x[a] / r
    out[0] += pull * 6.0 * q * q * (even * unit_x + odd * unit_y)
    out[1] += pull * 6.0 * q * q * (odd * unit_x - even * unit_y)
    out[2] += pull * polar


@kernel
def gravity_gradient(x, out):
    """Write the derivatives [1/s^2] of the gravity of point mass and J2 at `x` to `out` (3, 3).

    `x` (3,) [km] is in the axes of the night. The derivatives of the others are below 1e-5 of
    these.
    """
    z2 = x[2] * x[2]
    r2 = x[0] * x[0] + x[1] * x[1] + z2
    r3 = r2 * np.sqrt(r2)
    k = 1.5 * J2 * EARTH_RADIUS_KM**2 / r2
    for i in range(3):
        c = 3.0 if i == 2 else 1.0
        for j in range(3):
            total = -(3.0 + k * (5.0 * c - 35.0 * z2 / r2)) * x[i] * x[j] / r2
            if i == j:
                total += 1.0 + k * (c - 5.0 * z2 / r2)
            if j == 2:
                total -= 10.0 * k * x[2] * x[i] / r2
            out[i, j] = -GM_KM3_S2 / r3 * total


@kernel
def _add_body(x, body, gm, out):
    """Add the pull of a body at `body` on a satellite at `x`, less its pull on the Earth.

    `x` and `body` (3,) [km] are geocentric, in the axes of the night; `gm` [km^3/s^2] is of the
    body; the pull is added to `out` (3,) [km/s^2].
    """
    near, far = 0.0, 0.0
    for a in range(3):
        near += (body[a] - x[a]) ** 2
        far += body[a] ** 2
    near, far = near * np.sqrt(near), far * np.sqrt(far)
    for a in range(3):
        out[a] += gm * ((body[a] - x[a]) / near - body[a] / far)


@kernel
def _sunlight(x, sun, out):
    """Write the acceleration [km/s^2] of 1 m^2/kg in sunlight to `out`; 0 in the Earth's shadow.

    `x` and `sun` (3,) are geocentric positions [km] of satellite and Sun in the axes of the night,
    as those of `out` (3,).
    """
    away, along, far2 = 0.0, 0.0, 0.0
    for a in range(3):
        away += (x[a] - sun[a]) ** 2
        along += x[a] * sun[a]
        far2 += sun[a] ** 2
    r2 = x[0] ** 2 + x[1] ** 2 + x[2] ** 2
    in_shadow = along < 0.0 and r2 - along * along / far2 < EARTH_RADIUS_KM**2
    push = 0.0 if in_shadow else SUNLIGHT_PRESSURE_N_M2 / 1000.0 * AU_KM**2 / away
    for a in range(3):
        out[a] = push * (x[a] - sun[a]) / np.sqrt(away)


@kernel
def _air(x, v, out):
    """Write the acceleration [km/s^2] of 1 m^2/kg (drag coefficient included) by air to `out`.

    `x` (3,) [km], `v` (3,) [km/s] and `out` (3,) are in the axes of the night.
    """
    r = np.sqrt(x[0] ** 2 + x[1] ** 2 + x[2] ** 2)
    height = r - EARTH_RADIUS_KM * (1.0 - OBLATENESS * (x[2] / r) ** 2)
    layer = 0
    while layer < len(_AIR) - 1 and height >= _AIR[layer + 1, 0]:
        layer += 1
    fall = min(max((height - _AIR[layer, 0]) / _AIR[layer, 2], -1.0), 50.0)
    density = _AIR[layer, 1] * np.exp(-fall)
    wind_x = v[0] + EARTH_RATE_RAD_S * x[1]
    wind_y = v[1] - EARTH_RATE_RAD_S * x[0]
    speed = np.sqrt(wind_x**2 + wind_y**2 + v[2] ** 2)
    drag = -0.5e3 * density * speed
    out[0], out[1], out[2] = drag * wind_x, drag * wind_y, drag * v[2]


@kernel
def accelerate(t_s, x, v, areas, around, work, out):
    """Write the acceleration of a satellite to `out`, and its derivatives by the areas to `work`.

    Parameters
    ----------
    t_s : float
        Time since the origin of `around` [s].
    x, v : (3,) float
        Position [km] and velocity [km/s], in the axes of the night.
    areas : (2,) float
        Area over mass in sunlight and in the air [m^2/kg], with their coefficients; 0: without.
    around
        `Surroundings`.
    work : (4, 3) float, out
        Rows 0 and 1: derivatives by the areas [km/s^2 per m^2/kg]; the others are space to work.
    out : (3,) float, out
        Acceleration [km/s^2].
    """
    start_s, step_s, sun, moon, _, era_rad = around
    out[:] = 0.0
    work[:2] = 0.0
    _add_earth(x, era_rad + EARTH_RATE_RAD_S * t_s, out)
    _at_time(moon, start_s, step_s, t_s, work[2])
    _add_body(x, work[2], GM_MOON_KM3_S2, out)
    _at_time(sun, start_s, step_s, t_s, work[2])
    _add_body(x, work[2], GM_SUN_KM3_S2, out)
    _sunlight(x, work[2], work[0])
    _air(x, v, work[1])
    for p in range(N_AREAS):
        for a in range(3):
            out[a] += areas[p] * work[p, a]

"""Reference frames: states from EME2000, TEME and ITRF to GCRF, and from GCRF to those of messages.

Rotations are IAU 2006/2000A by pyerfa. The IERS corrections dX, dY (below 0.001 arcsec, 4 cm for
a low orbit) are neglected, as in astropy.

References
----------
IERS Conventions (2010), chapter 5. Vallado et al. (2006), Revisiting Spacetrack Report 3,
AIAA 2006-6753, appendix C (TEME).
"""

from typing import NamedTuple

import erfa
import numpy as np

from epipole.schemas.arrays import Array, Nanoseconds
from epipole.tasks.algorithms.constants import EARTH_RATE_RAD_S
from epipole.tasks.algorithms.times import tai_minus_utc_s, tt_julian_date, utc_julian_date

EME2000_FROM_GCRF: Array = erfa.bp06(2451545.0, 0.0)[0]  # rotation matrix: the frame bias
FRAMES = ("GCRF", "EME2000", "TEME", "ITRF")
MJD_JD = 2400000.5
# Time from node to node [ns]. The fastest term of nutation takes days: linear over ten minutes to
# 1e-6 arcsec.
NODE_NS = 600_000_000_000


def state_rotation(rotation: Array) -> Array:
    """Return the (6, 6) rotation of positions and velocities by a (3, 3) rotation.

    Not for axes that turn: there the velocity of the axes is missing.
    """
    return np.asarray(np.kron(np.eye(2), rotation), float)


class Orientation(NamedTuple):
    """Earth's orientation at n times, from an Earth-orientation table."""

    ut1: tuple[Array, Array]  # two-part Julian date
    xp_rad: Array
    yp_rad: Array
    sigma_rad: Array  # 1-sigma of the orientation outside the table; 0 within it


def orientation_at(
    time_ns: Nanoseconds, mjd: Array, ut1_utc_s: Array, xp_rad: Array, yp_rad: Array
) -> Orientation:
    """Return Earth's orientation at times, from a daily table.

    Outside the table its last (or first) value is used. After it, `sigma_rad` grows like the
    errors of IERS predictions (Bulletin A: UT1 0.00025 D^0.75 s, pole 0.00068 D^0.80 arcsec,
    after D days). Before it, the error is one second of UT1: the bound of UT1-UTC.

    Parameters
    ----------
    time_ns : (n,) int
        UTC since 1970.
    mjd, ut1_utc_s, xp_rad, yp_rad : (m,) float
        The table: UTC day, UT1-UTC [s] and polar motion [rad].
    """
    day, share = utc_julian_date(time_ns)
    at = (day - MJD_JD) + share
    # UT1-TAI, unlike UT1-UTC, has no step at a leap second.
    ut1_tai_s = ut1_utc_s - tai_minus_utc_s(MJD_JD + mjd)
    # TAI-UTC of the day's start: on a day with a leap second, erfa would divide by 86,401 s and
    # Unix time by 86,400 s.
    ut1_utc = (np.interp(at, mjd, ut1_tai_s) + tai_minus_utc_s(day)) / 86400.0
    ut1 = (day, share + ut1_utc)
    days = np.maximum(at - mjd[-1], 0.0)
    ut1_sigma_s = np.where(at < mjd[0], 1.0, 0.00025 * days**0.75)
    pole_sigma_rad = np.radians(0.00068 / 3600.0) * days**0.8
    return Orientation(
        ut1,
        np.interp(at, mjd, xp_rad),
        np.interp(at, mjd, yp_rad),
        np.hypot(ut1_sigma_s * EARTH_RATE_RAD_S, pole_sigma_rad),
    )


def gcrf_from_eme2000(r_km: Array, v_km_s: Array) -> tuple[Array, Array]:
    """Return GCRF positions and velocities, (n, 3), of those in EME2000 (mean J2000).

    They differ by the frame bias only: 0.02 arcsec.
    """
    return r_km @ EME2000_FROM_GCRF, v_km_s @ EME2000_FROM_GCRF


def gcrf_from_teme(
    time_ns: Nanoseconds, r_km: Array, v_km_s: Array, orientation: Orientation
) -> tuple[Array, Array]:
    """Return GCRF positions and velocities, (n, 3), of those in SGP4's frame TEME.

    TEME is rotated to Earth-fixed axes by the sidereal time of 1982, which is part of its
    definition, and from there to GCRF by the Earth rotation angle. Both use the same UT1, so its
    error cancels. The rotation of TEME itself (precession) is negligible for velocities.
    """
    gmst = erfa.gmst82(*orientation.ut1)
    R_gcrf_from_teme = _transpose(_tirs_from_gcrf(time_ns, orientation)) @ _about_z(gmst)
    return _rotate(R_gcrf_from_teme, r_km), _rotate(R_gcrf_from_teme, v_km_s)


def gcrf_from_itrf(
    time_ns: Nanoseconds, r_km: Array, v_km_s: Array, orientation: Orientation
) -> tuple[Array, Array]:
    """Return GCRF positions and velocities, (n, 3), of Earth-fixed ones (ITRF).

    A point at rest on Earth has velocity 0 in ITRF, and that of Earth's rotation in GCRF. The
    variation of the length of day (below 5 ms: 6e-8 of the rotation) is neglected.
    """
    tio = erfa.sp00(*tt_julian_date(time_ns))
    R_tirs_from_itrf = _transpose(erfa.pom00(orientation.xp_rad, orientation.yp_rad, tio))
    R_gcrf_from_tirs = _transpose(_tirs_from_gcrf(time_ns, orientation))
    r_tirs_km, v_tirs_km_s = _rotate(R_tirs_from_itrf, r_km), _rotate(R_tirs_from_itrf, v_km_s)
    rotation = np.array([0.0, 0.0, EARTH_RATE_RAD_S])
    v_tirs_km_s = v_tirs_km_s + np.cross(rotation, r_tirs_km)
    return _rotate(R_gcrf_from_tirs, r_tirs_km), _rotate(R_gcrf_from_tirs, v_tirs_km_s)


def to_gcrf(
    frame: str, time_ns: Nanoseconds, r_km: Array, v_km_s: Array, orientation: Orientation
) -> tuple[Array, Array]:
    """Return GCRF positions [km] and velocities [km/s] of states in a named frame.

    Parameters
    ----------
    frame
        One of `FRAMES`.
    time_ns : (n,) int
        UTC since 1970.
    r_km, v_km_s : (n, 3) float
        In that frame. NaN velocities remain NaN.
    orientation
        Earth's orientation at the same times.

    Raises
    ------
    ValueError
        If the frame is unknown.
    """
    if frame == "GCRF":
        return r_km.copy(), v_km_s.copy()
    if frame == "EME2000":
        return gcrf_from_eme2000(r_km, v_km_s)
    if frame == "TEME":
        return gcrf_from_teme(time_ns, r_km, v_km_s, orientation)
    if frame == "ITRF":
        return gcrf_from_itrf(time_ns, r_km, v_km_s, orientation)
    raise ValueError(f"expected a frame of {', '.join(FRAMES)}, got {frame!r}")


MESSAGE_FRAMES = ("GCRF", "EME2000", "ITRF")


def from_gcrf(frame: str, time_ns: Nanoseconds, orientation: Orientation) -> Array:
    """Return (n, 6, 6) matrices that turn states [km, km/s] from GCRF to a frame.

    Covariances too: multiply by the matrix and by its transpose.

    Parameters
    ----------
    frame
        One of `MESSAGE_FRAMES`. ITRF turns with the Earth: velocities are those past the ground.
    time_ns : (n,) int
        UTC since 1970.
    orientation
        Earth's orientation at the same times.
    """
    turn = np.zeros((len(time_ns), 6, 6))
    if frame != "ITRF":
        R = EME2000_FROM_GCRF if frame == "EME2000" else np.eye(3)
        turn[:, :3, :3] = turn[:, 3:, 3:] = R
        return turn
    tio = erfa.sp00(*tt_julian_date(time_ns))
    R_itrf_from_tirs = erfa.pom00(orientation.xp_rad, orientation.yp_rad, tio)
    R_tirs_from_gcrf = _tirs_from_gcrf(time_ns, orientation)
    rotation = EARTH_RATE_RAD_S * np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    turn[:, :3, :3] = turn[:, 3:, 3:] = R_itrf_from_tirs @ R_tirs_from_gcrf
    turn[:, 3:, :3] = -R_itrf_from_tirs @ rotation @ R_tirs_from_gcrf
    return turn


def _tirs_from_gcrf(time_ns: Nanoseconds, orientation: Orientation) -> Array:
    """Return (n, 3, 3): Earth's rotation, precession and nutation, without polar motion."""
    return _about_z(erfa.era00(*orientation.ut1)) @ _cirs_from_gcrf(time_ns)


def _cirs_from_gcrf(time_ns: Nanoseconds) -> Array:
    """Return (n, 3, 3), CIRS from GCRF: precession and nutation.

    The long series is evaluated at nodes only, and interpolated.
    """
    index = time_ns // NODE_NS
    nodes = np.unique(np.concatenate([index, index + 1]))
    at_nodes = np.stack(erfa.xys06a(*tt_julian_date(nodes * NODE_NS)), axis=-1)
    i = np.searchsorted(nodes, index)
    share = ((time_ns - index * NODE_NS) / NODE_NS)[:, None]
    xys = at_nodes[i] * (1 - share) + at_nodes[np.minimum(i + 1, len(nodes) - 1)] * share
    return erfa.c2ixys(xys[:, 0], xys[:, 1], xys[:, 2])


def _about_z(angle: Array) -> Array:
    """Return (n, 3, 3) rotations of the axes about z (R3 of the IERS Conventions)."""
    out = np.zeros((len(angle), 3, 3))
    out[:, 0, 0] = out[:, 1, 1] = np.cos(angle)
    out[:, 0, 1] = np.sin(angle)
    out[:, 1, 0] = -out[:, 0, 1]
    out[:, 2, 2] = 1.0
    return out


def _transpose(R: Array) -> Array:
    return np.swapaxes(R, -1, -2)


def _rotate(R: Array, vectors: Array) -> Array:
    return np.einsum("nij,nj->ni", R, vectors)

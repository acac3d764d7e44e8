"""Boresight and focal length from a few identified stars, in closed form or by Newton's method.

A star at distance a from the principal point is arctan(a / f) from the boresight d, so
``r . d = f / sqrt(f^2 + a^2)``: linear in d. Star identification in celestial navigation,
16th "Huawei Cup" graduate modelling contest (2019).
"""

from itertools import combinations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

MAX_STEPS = 50
CONVERGED = 1e-12  # relative change of the focal length
MOST_CHOSEN_FROM = 60  # stars; their triples are tried one and all


def boresight_of_three(u_icrs: Array, distance_px: Array, focal_px: float) -> Array:
    """Return the boresight from three stars and a known focal length.

    Parameters
    ----------
    u_icrs : (3, 3) float
        Apparent unit vectors to the stars, a row each.
    distance_px : (3,) float
        Their distances from the principal point in the image, distortion removed.
    focal_px : float

    Returns
    -------
    (3,) float
        Unit vector, ICRS axes.

    Raises
    ------
    ValueError
        If the shapes differ from these, or the stars lie on one great circle.
    """
    d = _free_boresight(u_icrs, _cosines(distance_px, focal_px))
    return d / np.linalg.norm(d)


def boresight_and_focal_length(
    u_icrs: Array, distance_px: Array, focal_px: float
) -> tuple[Array, float]:
    """Return the boresight and the focal length from three stars: |d| = 1 closes the system.

    Newton's method from `focal_px`, such as D / (2 tan(field / 2)); where two focal lengths
    fit, the one that it reaches. Parameters as `boresight_of_three`.

    Returns
    -------
    u_icrs : (3,) float
    focal_px : float
        NaN, as is the boresight, where no focal length makes |d| one.
    """
    d, f = np.full(3, np.nan), float(focal_px)
    for _ in range(MAX_STEPS):
        c = _cosines(distance_px, f)
        d = _free_boresight(u_icrs, c)
        slope = _free_boresight(u_icrs, np.square(distance_px) / (f**2 + distance_px**2) ** 1.5)
        with np.errstate(divide="ignore", invalid="ignore"):
            step = (d @ d - 1.0) / (2.0 * d @ slope)
        if not np.isfinite(step):
            break
        f = max(float(f - step), 0.5 * f)  # a step across zero would not come back
        if abs(step) < CONVERGED * f:
            d = _free_boresight(u_icrs, _cosines(distance_px, f))
            return d / np.linalg.norm(d), f
    return np.full(3, np.nan), np.nan


def focal_length_from_separations(x_px: Array, u_icrs: Array, focal_px: float) -> float:
    """Return the focal length with which image and sky have the same separations.

    Least squares over all pairs of stars, by Gauss-Newton from `focal_px`; no attitude is
    needed.

    Parameters
    ----------
    x_px : (n, 2) float
        Places in the image from the principal point, distortion removed. n >= 2.
    u_icrs : (n, 3) float
        Apparent unit vectors to the stars.

    Returns
    -------
    float
        NaN where separations do not fix it (all stars as far from the principal point along
        their line as the image stretches nothing), or the steps do not settle.
    """
    if len(x_px) != len(u_icrs) or len(x_px) < 2:
        raise ValueError(f"expected two or more stars, got {len(x_px)} places, {len(u_icrs)} stars")
    i, j = np.triu_indices(len(x_px), 1)
    wanted = _angle(u_icrs[i], u_icrs[j])
    product = np.sum(x_px[i] * x_px[j], axis=1)
    square = np.sum(x_px * x_px, axis=1)
    f = float(focal_px)
    for _ in range(MAX_STEPS):
        v = np.column_stack([x_px, np.full(len(x_px), f)])
        angle = _angle(v[i], v[j])
        a, b, n = square[i] + f * f, square[j] + f * f, product + f * f
        root = np.sqrt(a * b)
        slope_of_cosine = f * (2.0 - n * (a + b) / (a * b)) / root
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.where(angle > 0, -slope_of_cosine / np.sin(angle), 0.0)
            step = slope @ (wanted - angle) / (slope @ slope)
        if not np.isfinite(step):
            return np.nan
        f = max(f + step, 0.5 * f)
        if abs(step) < CONVERGED * f:
            return f
    return np.nan


def attitude_error(u: Array, sigma_rad: float) -> float:
    """Return how far an attitude of (n, 3) directions errs [rad], by the transfer of errors.

    sigma sqrt(tr((R R')^-1) / 2) with the directions as columns of R: for a matrix that is
    not bound to be a rotation, so it serves to compare sets of stars, not as a sigma to
    report (`attitude.attitude_covariance` does). Infinite for directions in one plane.
    """
    information = u.T @ u
    if len(u) < 3 or np.linalg.cond(information) > 1e14:
        return np.inf
    return float(sigma_rad * np.sqrt(0.5 * np.trace(np.linalg.inv(information))))


def best_three(u: Array) -> npt.NDArray[np.int64]:
    """Return the rows of the three directions with the least `attitude_error`, ascending.

    For three stars the error falls with the volume of their tetrahedron. All triples of the
    first 60 directions are tried.

    Raises
    ------
    ValueError
        With fewer than three directions.
    """
    if len(u) < 3:
        raise ValueError(f"expected three or more directions, got {len(u)}")
    rows = np.array(list(combinations(range(min(len(u), MOST_CHOSEN_FROM)), 3)), np.int64)
    a, b, c = (u[rows[:, k]] for k in range(3))
    ab, bc, ca = np.cross(a, b), np.cross(b, c), np.cross(c, a)
    volume = np.sum(a * bc, axis=1)
    # The rows of the inverse of [a b c] are these products over the volume.
    squares = sum(np.sum(p * p, axis=1) for p in (ab, bc, ca))
    with np.errstate(divide="ignore"):
        return rows[np.argmin(squares / volume**2)]


def _cosines(distance_px: Array, focal_px: float) -> Array:
    return focal_px / np.hypot(focal_px, distance_px)


def _free_boresight(u_icrs: Array, cosines: Array) -> Array:
    if u_icrs.shape != (3, 3) or cosines.shape != (3,):
        raise ValueError(f"expected three stars, got {u_icrs.shape} and {cosines.shape}")
    if np.linalg.cond(u_icrs) > 1e12:
        raise ValueError("the three stars lie on one great circle: their boresight is not fixed")
    boresight: Array = np.linalg.solve(u_icrs, cosines).astype(np.float64)
    return boresight


def _angle(a: Array, b: Array) -> Array:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))

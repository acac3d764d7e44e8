"""Boresight and focal length from a few identified stars, by hand and without an attitude.

The pipeline finds whole attitudes (`attitude`) and calibrates from thousands of stars
(`optics_calibration`). Where the focal length of a log is wrong, it starts from
`focal_length_from_separations`. The rest is for a single image with three or more stars whose
names are known. The page ``docs/methods/boresight.md`` has the equations and an example.

A star at distance a [px] from the principal point is at the angle arctan(a / f) from the
boresight d, so ``u . d = f / sqrt(f^2 + a^2)``: linear in d. Three stars give d; with
``|d| = 1`` they give the focal length f too.

References
----------
Star identification in celestial navigation, 16th "Huawei Cup" competition in mathematical
modelling for graduates (2019): the equations of this module.
"""

from itertools import combinations

import numpy as np

from epipole.schemas.arrays import Array, Integers

MAX_STEPS = 50  # of Newton's or Gauss-Newton's method; convergence takes about five
CONVERGED = 1e-12  # relative change of the focal length
MAX_CHOSEN_FROM = 60  # maximum number of stars of which all triples are tried


def boresight_of_three(u_icrs: Array, distance_px: Array, focal_px: float) -> Array:
    """Return the boresight from three stars and a known focal length.

    Parameters
    ----------
    u_icrs : (3, 3) float
        Apparent unit vectors to the stars, one row for each star.
    distance_px : (3,) float
        Distances of their images from the principal point, distortion removed.
    focal_px : float
        Focal length.

    Returns
    -------
    (3,) float
        Unit vector, ICRS axes.

    Raises
    ------
    ValueError
        If the shapes differ from these, or the stars lie on one great circle.

    Examples
    --------
    A sensor whose axes are those of the ICRS looks along z:

    >>> x_px = np.array([[300.0, 0.0], [0.0, 200.0], [-150.0, -100.0]])
    >>> u = np.column_stack([x_px, np.full(3, 2000.0)])
    >>> u /= np.linalg.norm(u, axis=1, keepdims=True)
    >>> d = boresight_of_three(u, np.hypot(x_px[:, 0], x_px[:, 1]), 2000.0)
    >>> np.allclose(d, [0.0, 0.0, 1.0])
    True
    """
    d = _free_boresight(u_icrs, _cosines(distance_px, focal_px))
    return d / np.linalg.norm(d)


def boresight_covariance(
    u_icrs: Array, distance_px: Array, focal_px: float, sigma_px: float
) -> Array:
    """Return the covariance of `boresight_of_three` [rad^2], to first order.

    Parameters
    ----------
    u_icrs, distance_px, focal_px
        As in `boresight_of_three`.
    sigma_px : float
        1-sigma error of a pixel position, per axis. The focal length is taken as exact.

    Returns
    -------
    (3, 3) float
        ICRS axes; singular along the boresight. The square root of half its trace is the
        1-sigma error per axis.

    Examples
    --------
    >>> x_px = np.array([[300.0, 0.0], [0.0, 200.0], [-150.0, -100.0]])
    >>> u = np.column_stack([x_px, np.full(3, 2000.0)])
    >>> u /= np.linalg.norm(u, axis=1, keepdims=True)
    >>> cov = boresight_covariance(u, np.hypot(x_px[:, 0], x_px[:, 1]), 2000.0, 0.1)
    >>> round(float(np.degrees(np.sqrt(np.trace(cov) / 2)) * 3600), 1)  # arcsec
    9.0
    """
    d = _free_boresight(u_icrs, _cosines(distance_px, focal_px))
    length = np.linalg.norm(d)
    sigma = sigma_px * focal_px * distance_px / (focal_px**2 + distance_px**2) ** 1.5
    across = (np.eye(3) - np.outer(d, d) / length**2) / length
    to_boresight = across @ np.linalg.inv(u_icrs) * sigma
    return np.asarray(to_boresight @ to_boresight.T, float)


def boresight_and_focal_length(
    u_icrs: Array, distance_px: Array, focal_px: float
) -> tuple[Array, float]:
    """Return the boresight and the focal length from three stars.

    Newton's method on ``|d| = 1`` from a first focal length, such as
    ``width_px / (2 tan(field / 2))``. Where two focal lengths are possible, it gives the one
    that it reaches.

    Parameters
    ----------
    u_icrs, distance_px
        As in `boresight_of_three`.
    focal_px : float
        First estimate.

    Returns
    -------
    u_icrs : (3,) float
        Boresight; NaN where no focal length makes its length one.
    focal_px : float
        Focal length; NaN likewise.

    Raises
    ------
    ValueError
        As `boresight_of_three`.

    Examples
    --------
    >>> x_px = np.array([[300.0, 0.0], [0.0, 200.0], [-150.0, -100.0]])
    >>> u = np.column_stack([x_px, np.full(3, 2000.0)])
    >>> u /= np.linalg.norm(u, axis=1, keepdims=True)
    >>> d, focal_px = boresight_and_focal_length(u, np.hypot(x_px[:, 0], x_px[:, 1]), 1900.0)
    >>> round(focal_px, 3)
    2000.0
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

    Least squares over all pairs of stars, by Gauss-Newton. No attitude is needed.

    Parameters
    ----------
    x_px : (n, 2) float
        Pixel positions relative to the principal point, distortion removed. n >= 2.
    u_icrs : (n, 3) float
        Apparent unit vectors to the stars.
    focal_px : float
        First estimate.

    Returns
    -------
    float
        NaN where the separations do not depend on the focal length, or without convergence.

    Raises
    ------
    ValueError
        With fewer than two stars, or another number of positions than of stars.

    Examples
    --------
    >>> x_px = np.array([[300.0, 0.0], [0.0, 200.0], [-150.0, -100.0]])
    >>> u = np.column_stack([x_px, np.full(3, 2000.0)])
    >>> u /= np.linalg.norm(u, axis=1, keepdims=True)
    >>> round(focal_length_from_separations(x_px, u, 1900.0), 3)
    2000.0
    """
    if len(x_px) != len(u_icrs) or len(x_px) < 2:
        raise ValueError(
            f"expected two or more stars, got {len(x_px)} positions, {len(u_icrs)} stars"
        )
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
            return float(f)
    return np.nan


def attitude_error(u: Array, sigma_rad: float) -> float:
    """Return a measure of how well (n, 3) directions fix an attitude [rad], to compare sets.

    It is sigma sqrt(tr((U' U)^-1) / 2) with the directions as rows of U: the error of a matrix
    that need not be a rotation. So it ranks sets of stars, but it is larger than the 1-sigma
    error (`boresight_covariance`, or `attitude.attitude_covariance` of a whole attitude).
    Infinite for directions in one plane.

    Examples
    --------
    >>> wide, narrow = np.eye(3), np.eye(3) + 1.0
    >>> narrow /= np.linalg.norm(narrow, axis=1, keepdims=True)
    >>> attitude_error(wide, 0.01) < attitude_error(narrow, 0.01)
    True
    """
    information = u.T @ u
    if len(u) < 3 or np.linalg.cond(information) > 1e14:
        return np.inf
    return float(sigma_rad * np.sqrt(0.5 * np.trace(np.linalg.inv(information))))


def best_three(u: Array) -> Integers:
    """Return the rows of the three directions with the least `attitude_error`, ascending.

    The error of three stars falls as the volume of their tetrahedron grows. All triples of the
    first 60 directions are tried.

    Raises
    ------
    ValueError
        With fewer than three directions.

    Examples
    --------
    >>> u = np.array([[1.0, 0.0, 0.0], [0.8, 0.6, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    >>> best_three(u).tolist()
    [0, 2, 3]
    """
    if len(u) < 3:
        raise ValueError(f"expected three or more directions, got {len(u)}")
    rows = np.array(list(combinations(range(min(len(u), MAX_CHOSEN_FROM)), 3)), np.int64)
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

"""Optics calibration: a sensor's focal lengths, principal point and distortion from its stars.

All frames share the optics. Each frame has its own small rotation, which is eliminated frame by
frame (Schur complement), so the cost grows linearly with the number of stars.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.geometry.camera import Camera, project

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

OPTICS = ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
# 1-sigma prior about the given calibration. It only matters for what the stars do not determine:
# in a narrow field a shift of the principal point equals a rotation of the sensor, and the
# higher terms of the distortion are negligible.
FOCAL_SHARE = 0.02
CORNER_PX = 20.0
PRINCIPAL_POINT_PX = 5.0
STEPS = 15
HUBER = 2.0  # [sigma] larger residuals have less weight
LEAST_FRAMES, LEAST_STARS = 3, 60


class OpticsFit(NamedTuple):
    """Optics with their covariance (9, 9), in the order of OPTICS.

    residual_px : robust rms of the image residuals, per axis
    gain : decrease of chi-square from the given optics, with free attitudes in both; at most
        the squared distance of the optics in units of `cov`; about 9 by chance
    """

    camera: Camera
    cov: Array
    n_stars: int
    residual_px: float
    gain: float


class _Fit(NamedTuple):
    camera: Camera
    u: Array  # stars in the sensor frame, after the fitted rotations
    cov: Array  # of the optics, in units of their prior
    residual: Array
    sigma_px: float
    score: Array  # (n, 9): weighted gradient of each star image, in units of the prior


def calibrate_optics(
    camera: Camera,
    x_px: Array,
    y_px: Array,
    u_sensor: Array,
    frame: npt.NDArray[np.int64],
    star: npt.NDArray[np.int64],
) -> OpticsFit | None:
    """Return the optics that fit identified stars best, None with too few stars.

    Parameters
    ----------
    camera
        The given calibration: start and prior of the fit.
    x_px, y_px : (n,) float
        Measured image places of the stars.
    u_sensor : (n, 3) float
        Their catalogue directions in the sensor frame. The attitudes may come from wrong
        optics: a rotation of each frame is fitted too.
    frame : (n,) int
        Number of the frame; the stars of a frame are consecutive.
    star : (n,) int
        Number of the star. Errors of the catalogue, and of close pairs that are one image, are
        the same in every frame. The covariance includes them, however many frames there are.

    References
    ----------
    Triggs et al. (2000), Bundle adjustment: a modern synthesis, section 6.1 (Schur
    complement); Huber's weights, scaled by the median absolute residual. Cameron and Miller
    (2015), A practitioner's guide to cluster-robust inference: errors shared by a star's images.
    """
    change = np.flatnonzero(np.diff(frame)) + 1
    starts = np.concatenate([[0], change])
    if len(frame) < LEAST_STARS or len(starts) < LEAST_FRAMES:
        return None
    xy = np.stack([x_px, y_px], axis=1)
    fixed = _fit(camera, xy, u_sensor, starts, False)
    free = _fit(camera, xy, fixed.u, starts, True)
    cost = [_huber_cost(f.residual / free.sigma_px) for f in (fixed, free)]
    cov = _with_shared_errors(free, star) * np.outer(*[_prior_sigma(camera)] * 2)
    off = _values(free.camera) - _values(camera)
    distance = float(off @ np.linalg.solve(cov, off))
    return OpticsFit(free.camera, cov, len(frame), free.sigma_px, min(cost[0] - cost[1], distance))


def _with_shared_errors(fit: _Fit, star: npt.NDArray[np.int64]) -> Array:
    """Return the covariance, in units of the prior, with the errors that a star's images share."""
    _, of_star = np.unique(star, return_inverse=True)
    n = of_star.max() + 1
    pull = np.zeros((n, 9))
    np.add.at(pull, of_star, fit.score)
    few = n / max(n - 9, 1)  # for the degrees of freedom of the fit
    shared = fit.cov @ (few * pull.T @ pull - fit.score.T @ fit.score) @ fit.cov
    value, vector = np.linalg.eigh(shared)
    return fit.cov + (vector * np.maximum(value, 0.0)) @ vector.T


def _fit(camera: Camera, xy: Array, u: Array, starts: Indices, optics: bool) -> _Fit:
    """Return the best rotations of the frames and, if `optics`, the best optics."""
    scale = _prior_sigma(camera)
    came = _values(camera)
    of_frame = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(xy))))
    used = 2 * len(xy) - 3 * len(starts) - 9
    for _ in range(STEPS):
        r, J_turn, J_optics = _linearise(camera, xy, u)
        sigma = _robust_sigma(r, used)
        weight = np.minimum(1.0, HUBER * sigma / np.maximum(np.abs(r), 1e-12)) / sigma**2
        J_optics = J_optics * scale
        A = np.add.reduceat(np.einsum("nai,na,naj->nij", J_turn, weight, J_turn), starts)
        A += (
            1e-9 * np.trace(A, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        )  # all stars at one place
        b = np.add.reduceat(np.einsum("nai,na->ni", J_turn, weight * r), starts)
        step, cov, score = np.zeros(9), np.zeros((9, 9)), np.zeros((len(xy), 9))
        turn = np.linalg.solve(A, b[..., None])[..., 0]
        if optics:
            B = np.add.reduceat(np.einsum("nai,na,naj->nij", J_turn, weight, J_optics), starts)
            lever = np.linalg.solve(A, B)  # rotations that compensate a change of the optics
            C = np.einsum("nai,na,naj->ij", J_optics, weight, J_optics) + np.eye(9)
            C -= np.einsum("fki,fkj->ij", B, lever)
            c = np.einsum("nai,na->i", J_optics, weight * r) - (_values(camera) - came) / scale
            cov = np.linalg.inv(C)
            step = cov @ (c - np.einsum("fki,fk->i", B, turn))
            turn = turn - lever @ step
            reduced = J_optics - J_turn @ lever[of_frame]
            score = np.einsum("nai,na->ni", reduced, weight * r)
            camera = _moved(camera, step * scale)
        u = u + np.cross(turn[of_frame], u)
        u = u / np.linalg.norm(u, axis=1, keepdims=True)
        if np.abs(turn).max() < 1e-3 * sigma * camera.pixel_rad and np.abs(step).max() < 1e-6:
            break
    r, _, _ = _linearise(camera, xy, u)
    return _Fit(camera, u, cov, r, _robust_sigma(r, used), score)


def _values(camera: Camera) -> Array:
    return np.array([getattr(camera, name) for name in OPTICS])


def _moved(camera: Camera, step: Array) -> Camera:
    values = (_values(camera) + step).tolist()
    return camera._replace(**dict(zip(OPTICS, values, strict=True)))


def _prior_sigma(camera: Camera) -> Array:
    """Return the 1-sigma prior of each number of OPTICS."""
    f, r = np.sqrt(camera.fx_px * abs(camera.fy_px)), np.tan(camera.half_diagonal_rad)
    at_corner = CORNER_PX / f / np.array([r**3, r**5, r**2, r**2, r**7])
    return np.array([FOCAL_SHARE * f] * 2 + [PRINCIPAL_POINT_PX] * 2 + at_corner.tolist())


def _robust_sigma(residual: Array, degrees_of_freedom: int) -> float:
    """Return the residuals' rms from their median, corrected for the degrees of freedom."""
    spread = 1.4826 * float(np.median(np.abs(residual)))
    return max(spread * np.sqrt(residual.size / max(degrees_of_freedom, 1)), 1e-4)


def _huber_cost(z: Array) -> float:
    size = np.abs(z)
    return float(np.sum(np.where(size < HUBER, size**2, 2 * HUBER * size - HUBER**2)))


def _linearise(camera: Camera, xy: Array, u: Array) -> tuple[Array, Array, Array]:
    """Return residuals (n, 2) [px], and derivatives of the image places by the rotation (n, 2, 3)
    and by the optics (n, 2, 9)."""
    x, y = u[:, 0] / u[:, 2], u[:, 1] / u[:, 2]
    r2, xy2 = x * x + y * y, 2 * x * y
    k1, k2, p1, p2, k3 = camera.k1, camera.k2, camera.p1, camera.p2, camera.k3
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2 * (k1 + r2 * (2 * k2 + 3 * k3 * r2))
    stretch = np.empty((len(x), 2, 2))
    stretch[:, 0, 0] = radial + slope * x * x + 2 * p1 * y + 6 * p2 * x
    stretch[:, 1, 1] = radial + slope * y * y + 6 * p1 * y + 2 * p2 * x
    stretch[:, 0, 1] = stretch[:, 1, 0] = slope * x * y + 2 * p1 * x + 2 * p2 * y
    turned = np.empty((len(x), 2, 3))  # derivative of the undistorted place by the rotation vector
    turned[:, 0] = np.stack([-x * y, 1 + x * x, -y], axis=1)
    turned[:, 1] = np.stack([-1 - y * y, x * y, x], axis=1)
    f = np.array([camera.fx_px, camera.fy_px])
    px, py = project(camera, u)
    moved = np.zeros((len(x), 2, 9))
    moved[:, 0, 0], moved[:, 1, 1] = (px - camera.cx_px) / f[0], (py - camera.cy_px) / f[1]
    moved[:, 0, 2] = moved[:, 1, 3] = 1.0
    for column, power in ((4, 1), (5, 2), (8, 3)):
        moved[:, 0, column], moved[:, 1, column] = f[0] * x * r2**power, f[1] * y * r2**power
    moved[:, 0, 6], moved[:, 1, 6] = f[0] * xy2, f[1] * (r2 + 2 * y * y)
    moved[:, 0, 7], moved[:, 1, 7] = f[0] * (r2 + 2 * x * x), f[1] * xy2
    J_turn = f[:, None] * np.einsum("nij,njk->nik", stretch, turned)
    return xy - np.stack([px, py], axis=1), J_turn, moved

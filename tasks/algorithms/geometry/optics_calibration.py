"""Optics calibration: a sensor's focal lengths, principal point and distortion from its stars.

All frames share the optics. Each frame has a small rotation, which is eliminated frame by frame
(Schur complement): the cost grows linearly with the number of stars.

There are two fits. `calibrate_optics`, with all parameters free, decides whether the optics differ
from the given ones. If they do, `calibrate_in_steps` changes only those parameters that lower
chi-square enough (Bayesian information criterion).
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Indices
from epipole.tasks.algorithms.geometry.camera import Camera, project
from epipole.tasks.algorithms.geometry.covariances import OPTICS, image_derivatives
from epipole.tasks.algorithms.kernels import kernel

# 1-sigma prior about the given calibration. It matters only for what the stars do not determine: in
# a narrow field a shift of the principal point equals a rotation of the sensor, and the higher
# terms of the distortion are negligible.
FOCAL_SHARE = 0.02  # of the focal length
CORNER_PX = 20.0  # effect of a term of the distortion at the corners of the image
# A detector of 6 mm, mounted with usual tolerances of about 30 micrometres.
PRINCIPAL_POINT_SHARE = 0.005  # of the image's size
MIN_PRINCIPAL_POINT_PX = 1e-3  # if the principal point is stated as exact
MAX_ITERATIONS = 15
# A fit ends with a step of the optics below this share of their sigmas, and of each frame's turn
# below this share of a star image's error. Steps fall by ten each (Huber's weights follow), so the
# rest is a tenth of it, and the rest of chi-square the square of that.
SETTLED = 0.02
HUBER = 2.0  # [sigma] larger residuals have less weight
MIN_FRAMES, MIN_STARS = 3, 60  # minimum numbers for a fit
# The principal point is free only if its sigma, with all parameters free, is below this share of
# its prior. Otherwise it cannot be separated from a rotation of the sensor.
MAX_SIGMA_SHARE = 0.5


def _direction(**weights: float) -> Array:
    """Return a unit vector in the space of `OPTICS`, (9, 1)."""
    column = np.array([[weights.get(name, 0.0)] for name in OPTICS])
    return column / np.linalg.norm(column)


# In the order of their usual effects, the largest first.
STEPS = (
    _direction(fx_px=1.0, fy_px=1.0),
    _direction(k1=1.0),
    _direction(fx_px=1.0, fy_px=-1.0),  # pixels that are not square
    _direction(k2=1.0),
    _direction(k3=1.0),
)
FIXED = np.zeros((9, 0))
TANGENTIAL = np.hstack([_direction(p1=1.0), _direction(p2=1.0)])
PRINCIPAL_POINT = np.hstack([_direction(cx_px=1.0), _direction(cy_px=1.0)])


class NominalOptics(NamedTuple):
    """The calibration of a log: the prior of the fits.

    principal_point_px : 1-sigma error of the principal point, per axis; None: that of an
        assembled camera
    """

    camera: Camera
    principal_point_px: float | None = None

    @property
    def sigma(self) -> Array:
        """1-sigma prior of each parameter of `OPTICS`, (9,)."""
        camera = self.camera
        f, r = np.sqrt(camera.fx_px * abs(camera.fy_px)), camera.corner_distance
        at_corner = CORNER_PX / f / np.array([r**3, r**5, r**2, r**2, r**7])
        point_px = self.principal_point_px
        if point_px is None:
            point_px = PRINCIPAL_POINT_SHARE * max(camera.width, camera.height)
        point_px = max(point_px, MIN_PRINCIPAL_POINT_PX)
        return np.array([FOCAL_SHARE * f] * 2 + [point_px] * 2 + at_corner.tolist())


class StarImages(NamedTuple):
    """Images of identified stars, frame by frame.

    x_px, y_px : (n,) float
        Measured pixel positions.
    u_sensor : (n, 3) float
        Catalogue directions in the sensor frame. The attitudes may be from wrong optics: a rotation
        of each frame is fitted too.
    frame : (n,) int
        Number of the frame; the stars of a frame are consecutive.
    star : (n,) int
        Number of the star. Errors of the catalogue and of blended pairs are the same in every
        frame. Covariances include them; they do not average out.
    """

    x_px: Array
    y_px: Array
    u_sensor: Array
    frame: Indices
    star: Indices


class OpticsFit(NamedTuple):
    """Optics with their covariance (9, 9), in the order of OPTICS.

    residual_px : robust rms of the image residuals, per axis
    gain : decrease of chi-square from the present optics, with free attitudes in both; at most
        the squared Mahalanobis distance of the optics by `cov`; expected from noise: about 9
    n_independent : number of independent images that would determine the optics equally well
    """

    camera: Camera
    cov: Array
    n_stars: int
    residual_px: float
    gain: float
    n_independent: float


class _Images(NamedTuple):
    """The images, grouped by frame and star."""

    xy: Array
    starts: Indices  # of each frame
    of_frame: Indices
    of_star: Indices


class _Fit(NamedTuple):
    camera: Camera
    u: Array  # stars in the sensor frame, after the fitted rotations
    moved: Array  # (k,) free parameters minus the given calibration, in units of the prior
    cov: Array  # (k, k) its covariance
    residual: Array
    sigma_px: float
    score: Array  # (n, k): weighted gradient of each star image


class _Choice(NamedTuple):
    """A basis (9, k) of the free parameters, and its fit."""

    fit: _Fit
    basis: Array


def calibrate_optics(
    given: NominalOptics, images: StarImages, present: Camera | None = None
) -> OpticsFit | None:
    """Return the optics that fit identified stars best, with all parameters free; None if too few.

    Parameters
    ----------
    given
        The calibration of the log: the prior of the fit.
    present
        The optics to begin with, which the gain is counted from; default: the given ones.

    References
    ----------
    Triggs et al. (2000), Bundle adjustment: a modern synthesis, section 6.1 (Schur
    complement); Huber's weights, scaled by the median absolute residual. Cameron and Miller
    (2015), A practitioner's guide to cluster-robust inference: errors shared by a star's images.
    """
    grouped = _grouped(images)
    if grouped is None:
        return None
    present = present or given.camera
    fixed = _fit(given, present, grouped, images.u_sensor, FIXED)
    free = _fit(given, present, grouped, fixed.u, np.eye(9))
    shared, scale = _with_shared_errors(free, grouped.of_star), given.sigma
    cov = shared * np.outer(scale, scale)
    gain = _gain(fixed, free, cov, free.sigma_px)
    times = float(np.trace(np.linalg.solve(free.cov, shared))) / 9
    n = len(grouped.xy)
    return OpticsFit(free.camera, cov, n, free.sigma_px, gain, n / times)


def calibrate_in_steps(
    given: NominalOptics, images: StarImages, free: OpticsFit, present: Camera | None = None
) -> OpticsFit:
    """Return optics that differ from the given ones only in parameters that the stars demand.

    A free parameter that the stars do not demand absorbs errors of others: the principal point
    those of the tangential terms, and it biases the attitude.

    Parameters
    ----------
    given
        The calibration of the log. Its principal point is as uncertain as the prior unless the
        stars determine it.
    free
        The fit of all parameters to the same images, from `calibrate_optics`.
    present
        The optics to begin with, which the gain is counted from; default: the given ones.

    Returns
    -------
    OpticsFit
        `cov` is the mean square of the error: the covariance with all parameters free, plus the
        square of the difference to that fit. So it includes the parameters that are fixed.

    References
    ----------
    Schwarz (1978), Estimating the dimension of a model: a parameter is demanded if it lowers
    chi-square by more than the logarithm of the number of images. Kish (1965), Survey sampling,
    section 8.2: of images that share errors, fewer are independent.
    """
    grouped = _grouped(images)
    if grouped is None:
        return free
    sigma, penalty = free.residual_px, np.log(max(free.n_independent, 1.0))
    fixed = start = _fit(given, present or given.camera, grouped, images.u_sensor, FIXED, sigma)
    if present not in (None, given.camera):
        start = _fit(given, given.camera, grouped, fixed.u, FIXED, sigma)
    radial = _with_steps(given, grouped, _Choice(start, FIXED), STEPS, penalty)
    # The model of a fisheye has no tangential terms.
    tangential = [] if given.camera.fisheye else [TANGENTIAL]
    best = _with_steps(given, grouped, radial, tangential, penalty)
    if _determines_principal_point(free.cov, given.sigma):
        # Tangential terms may only imitate the principal point: it is also tried before them.
        before = _with_steps(given, grouped, radial, [PRINCIPAL_POINT, *tangential], penalty)
        after = _with_steps(given, grouped, best, [PRINCIPAL_POINT], penalty)
        best = min(before, after, key=lambda choice: _criterion(given, choice, penalty))
    rest = _values(free.camera) - _values(best.fit.camera)
    return free._replace(
        camera=best.fit.camera,
        cov=free.cov + np.outer(rest, rest),
        residual_px=_robust_sigma(best.fit.residual, _degrees_of_freedom(grouped, best.basis)),
        gain=_gain(fixed, best.fit, free.cov, sigma),
    )


def fit_radial(camera: Camera, x_px: Array, y_px: Array, u_sensor: Array) -> Camera:
    """Return the camera with the focal length and k1 that fit the stars of one frame best.

    Parameters
    ----------
    camera
        To start from; the prior of the fit.
    x_px, y_px : (n,) float
        Measured pixel positions of at least 4 stars.
    u_sensor : (n, 3) float
        Their catalogue directions in the sensor frame; a rotation of all is fitted too.
    """
    frame = np.zeros(len(x_px), np.int64)
    images = _Images(np.stack([x_px, y_px], axis=1), frame[:1], frame, frame)
    focal = _direction(fx_px=1.0, fy_px=np.sign(camera.fy_px))  # < 0: rows that count upward
    basis = np.hstack([focal, _direction(k1=1.0)])
    return _fit(NominalOptics(camera), camera, images, u_sensor, basis).camera


def _grouped(images: StarImages) -> _Images | None:
    """Return the images grouped by frame and star, None if they are too few."""
    starts = np.concatenate([[0], np.flatnonzero(np.diff(images.frame)) + 1])
    n = len(images.frame)
    if n < MIN_STARS or len(starts) < MIN_FRAMES:
        return None
    of_frame = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, n)))
    _, of_star = np.unique(images.star, return_inverse=True)
    return _Images(np.stack([images.x_px, images.y_px], axis=1), starts, of_frame, of_star)


def _determines_principal_point(cov: Array, scale: Array) -> bool:
    """Return whether the stars separate the principal point from a rotation of the sensor."""
    point = [OPTICS.index("cx_px"), OPTICS.index("cy_px")]
    worst = np.linalg.eigvalsh(cov[np.ix_(point, point)])[-1]
    return bool(np.sqrt(worst) < MAX_SIGMA_SHARE * scale[point[0]])


def _gain(fixed: _Fit, fit: _Fit, cov: Array, sigma_px: float) -> float:
    """Return the decrease of chi-square, at most the squared Mahalanobis distance by `cov`."""
    off = _values(fit.camera) - _values(fixed.camera)
    decrease = _huber_cost(fixed.residual / sigma_px) - _huber_cost(fit.residual / sigma_px)
    return min(decrease, float(off @ np.linalg.solve(cov, off)))


def _with_steps(
    given: NominalOptics, images: _Images, choice: _Choice, steps: Sequence[Array], penalty: float
) -> _Choice:
    """Return the choice with those of the steps that the stars demand, tested in order."""
    for step in steps:
        wider, n = np.hstack([choice.basis, step]), step.shape[1]
        fit = _fit(given, choice.fit.camera, images, choice.fit.u, wider, choice.fit.sigma_px)
        decrease = _cost(given, choice.fit) - _cost(given, fit)
        # Errors that a star's images share may lower chi-square without significance.
        cov, moved = _with_shared_errors(fit, images.of_star)[-n:, -n:], fit.moved[-n:]
        if min(decrease, float(moved @ np.linalg.solve(cov, moved))) > n * penalty:
            choice = _Choice(fit, wider)
    return choice


def _criterion(given: NominalOptics, choice: _Choice, penalty: float) -> float:
    return _cost(given, choice.fit) + penalty * choice.basis.shape[1]


def _cost(given: NominalOptics, fit: _Fit) -> float:
    """Return chi-square, prior included."""
    prior = (_values(fit.camera) - _values(given.camera)) / given.sigma
    return _huber_cost(fit.residual / fit.sigma_px) + float(prior @ prior)


def _with_shared_errors(fit: _Fit, of_star: Indices) -> Array:
    """Return the covariance, in units of the prior, with the errors that a star's images share."""
    n, k = of_star.max() + 1, len(fit.cov)
    pull = np.zeros((n, k))
    np.add.at(pull, of_star, fit.score)
    # The fit follows each star's error in part, by the star's leverage: the scores are too small.
    # The correction is squared: conservative for few stars (CV3 of Cameron and Miller).
    correction = (n / max(n - k, 1)) ** 2
    shared = fit.cov @ (correction * pull.T @ pull - fit.score.T @ fit.score) @ fit.cov
    value, vector = np.linalg.eigh(shared)
    return fit.cov + (vector * np.maximum(value, 0.0)) @ vector.T


def _fit(
    given: NominalOptics,
    camera: Camera,
    images: _Images,
    u: Array,
    basis: Array,
    sigma_px: float = 0.0,
) -> _Fit:
    """Return the best rotations of the frames, and the best optics in the space of `basis`.

    Parameters
    ----------
    basis : (9, k) float
        Free directions of the parameters, in units of the prior.
    sigma_px
        1-sigma error of the images, per axis; 0: from the residuals.
    """
    scale, nominal, k = given.sigma, _values(given.camera), basis.shape[1]
    used = _degrees_of_freedom(images, basis)
    for _ in range(MAX_ITERATIONS):
        r, J_turn, J_optics = _linearise(camera, images.xy, u)
        sigma = max(sigma_px, _robust_sigma(r, used))  # far from the optimum all weights are 1
        weight = np.minimum(1.0, HUBER * sigma / np.maximum(np.abs(r), 1e-12)) / sigma**2
        J_optics = (J_optics.reshape(-1, 9) @ (scale[:, None] * basis)).reshape(len(r), 2, k)
        A, b, B, C, c = _normal_equations(J_turn, J_optics, weight, r, images.starts)
        # Also with all stars of a frame at one position.
        A += 1e-9 * np.trace(A, axis1=1, axis2=2)[:, None, None] * np.eye(3)
        turn = np.linalg.solve(A, b[..., None])[..., 0]
        # Rotations that compensate a change of the optics.
        lever = np.asarray(np.linalg.solve(A, B), np.float64)
        C += np.eye(k) - np.tensordot(B, lever, axes=((0, 1), (0, 1)))
        c -= basis.T @ ((_values(camera) - nominal) / scale)
        cov = np.asarray(np.linalg.inv(C), np.float64)
        step = cov @ (c - np.tensordot(turn, B, axes=2))
        turn = turn - lever @ step
        camera = _moved(camera, (basis @ step) * scale)
        u = u + np.cross(turn[images.of_frame], u)
        u = u / np.linalg.norm(u, axis=1, keepdims=True)
        still = np.abs(step / np.sqrt(np.diag(cov))).max(initial=0.0) < SETTLED
        if still and np.abs(turn).max() < SETTLED * sigma * camera.pixel_rad:
            break
    score = _scores(J_turn, J_optics, weight * r, lever, images.of_frame)
    r = _residuals(camera, images.xy, u)
    moved = basis.T @ ((_values(camera) - nominal) / scale)
    return _Fit(camera, u, moved, cov, r, sigma_px or _robust_sigma(r, used), score)


@kernel
def _normal_equations(J_turn, J_optics, weight, r, starts):
    """Return the sums over the star images that the normal equations of the fit consist of.

    J_turn (n, 2, 3) [px/rad] and J_optics (n, 2, k) are derivatives of the images by the rotation
    of their frame and by the free parameters, `weight` (n, 2) is 1/variance [px^-2], r (n, 2) are
    residuals [px], starts (f,) the first image of each frame. Result: J_turn' J_turn (f, 3, 3),
    J_turn' r (f, 3) and J_turn' J_optics (f, 3, k) of each frame, J_optics' J_optics (k, k) and
    J_optics' r (k,) of all, weighted.
    """
    k, ends = J_optics.shape[2], np.append(starts[1:], len(r))
    A, b = np.zeros((len(starts), 3, 3)), np.zeros((len(starts), 3))
    B, C, c = np.zeros((len(starts), 3, k)), np.zeros((k, k)), np.zeros(k)
    for i in range(len(starts)):
        for n in range(starts[i], ends[i]):
            for axis in range(2):
                turn, optics = J_turn[n, axis], J_optics[n, axis]
                w, pull = weight[n, axis], weight[n, axis] * r[n, axis]
                for p in range(3):
                    b[i, p] += turn[p] * pull
                    for q in range(3):
                        A[i, p, q] += w * turn[p] * turn[q]
                    for q in range(k):
                        B[i, p, q] += w * turn[p] * optics[q]
                for p in range(k):
                    c[p] += optics[p] * pull
                    for q in range(k):
                        C[p, q] += w * optics[p] * optics[q]
    return A, b, B, C, c


def _scores(J_turn: Array, J_optics: Array, pull: Array, lever: Array, frame: Indices) -> Array:
    """Return the gradient (n, k) of each star image by the optics, frames turned along with it."""
    pulled = np.einsum("nai,na->ni", J_turn, pull)
    return np.asarray(
        np.einsum("nai,na->ni", J_optics, pull) - np.einsum("ni,nij->nj", pulled, lever[frame])
    )


def _values(camera: Camera) -> Array:
    return np.array([getattr(camera, name) for name in OPTICS])


def _moved(camera: Camera, step: Array) -> Camera:
    values = (_values(camera) + step).tolist()
    return camera._replace(**dict(zip(OPTICS, values, strict=True)))


def _degrees_of_freedom(images: _Images, basis: Array) -> int:
    return 2 * len(images.xy) - 3 * len(images.starts) - basis.shape[1]


def _robust_sigma(residual: Array, degrees_of_freedom: int) -> float:
    """Return the residuals' rms from their median, corrected for the degrees of freedom."""
    spread = 1.4826 * float(np.median(np.abs(residual)))
    return max(spread * np.sqrt(residual.size / max(degrees_of_freedom, 1)), 1e-4)


def _huber_cost(z: Array) -> float:
    size = np.abs(z)
    return float(np.sum(np.where(size < HUBER, size**2, 2 * HUBER * size - HUBER**2)))


def _linearise(camera: Camera, xy: Array, u: Array) -> tuple[Array, Array, Array]:
    """Return residuals (n, 2) [px], and `image_derivatives`."""
    return _residuals(camera, xy, u), *image_derivatives(camera, u)


def _residuals(camera: Camera, xy: Array, u: Array) -> Array:
    return xy - np.stack(project(camera, u), axis=1)

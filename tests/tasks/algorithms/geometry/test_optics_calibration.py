"""A sensor's optics from its stars."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from epipole.tasks.algorithms.geometry.camera import Camera, inside, project, unproject
from epipole.tasks.algorithms.geometry.covariances import OPTICS, shared_attitude_covariance
from epipole.tasks.algorithms.geometry.optics_calibration import (
    NominalOptics,
    StarImages,
    calibrate_in_steps,
    calibrate_optics,
)

SENT = Camera(1024, 1024, 3660.0, 3660.0, 511.5, 511.5)  # 16 degrees
TRUE = SENT._replace(fx_px=3671.0, fy_px=3670.0, cx_px=513.0, cy_px=509.0, k1=-0.08, p1=3e-4)


def stars(camera, seed=0, n_frames=60, n_stars=25, sigma_px=0.15, wrong=0.0, turn=3e-4):
    """Return images of stars, their directions with small errors of the frames' attitudes."""
    rng = np.random.default_rng(seed)
    u, frame, x, y = [], [], [], []
    edge = 1.05 * np.tan(camera.half_diagonal_rad) / np.sqrt(2)
    for k in range(n_frames):
        v = np.column_stack([rng.uniform(-edge, edge, (n_stars, 2)), np.ones(n_stars)])
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        px, py = project(camera, v)
        seen = inside(camera, px, py)
        u.append(Rotation.from_rotvec(rng.normal(0, turn, 3)).apply(v[seen]))
        x.append(px[seen]), y.append(py[seen])
        frame.append(np.full(seen.sum(), k))
    x, y = np.concatenate(x), np.concatenate(y)
    x, y = x + rng.normal(0, sigma_px, len(x)), y + rng.normal(0, sigma_px, len(x))
    x += np.where(rng.uniform(size=len(x)) < wrong, rng.uniform(-5, 5, len(x)), 0.0)
    return StarImages(x, y, np.concatenate(u), np.concatenate(frame), np.arange(len(x)))


def same_stars_drifting(camera, seed, off_px, n_frames=200, n_stars=40):
    """Return the same as `stars`, for the same stars in all frames, with errors of catalogue."""
    rng = np.random.default_rng(seed)
    at = np.column_stack([rng.uniform(-0.2, 0.15, n_stars), rng.uniform(-0.15, 0.15, n_stars)])
    shift = rng.normal(0, off_px / camera.fx_px, (n_stars, 2))
    rows = []
    for k in range(n_frames):
        drift = np.array([0.05 * k / n_frames, 0.0])
        v, shown = (
            np.column_stack([place + drift, np.ones(n_stars)]) for place in (at, at + shift)
        )
        px, py = project(camera, shown / np.linalg.norm(shown, axis=1, keepdims=True))
        v /= np.linalg.norm(v, axis=1, keepdims=True)
        seen = np.flatnonzero(inside(camera, px, py))
        noise = rng.normal(0, 0.15, (2, len(seen)))
        rows.append(
            (px[seen] + noise[0], py[seen] + noise[1], v[seen], np.full(len(seen), k), seen)
        )
    return StarImages(*(np.concatenate(column) for column in zip(*rows, strict=True)))


def test_optics_come_back_without_noise():
    fit = calibrate_optics(NominalOptics(SENT), stars(TRUE, sigma_px=0.0))
    got_x, got_y = project(fit.camera, np.array([[0.12, 0.11, 1.0]]))
    true_x, true_y = project(TRUE, np.array([[0.12, 0.11, 1.0]]))
    assert fit.residual_px < 2e-3
    assert fit.camera.fx_px == pytest.approx(TRUE.fx_px, abs=0.1)
    assert np.hypot(got_x - true_x, got_y - true_y) < 0.1


def test_errors_over_sigmas_are_standard_normal():
    z = []
    for seed in range(40):
        fit = calibrate_optics(NominalOptics(SENT), stars(TRUE, seed))
        sigma = np.sqrt(np.diagonal(fit.cov))
        z.append(
            [
                (getattr(fit.camera, n) - getattr(TRUE, n)) / s
                for n, s in zip(OPTICS, sigma, strict=True)
            ]
        )
    z = np.array(z)
    # What only the prior determines is nearer to it than by chance.
    assert np.all(np.sqrt(np.mean(z**2, axis=0)) < 1.35)
    assert np.sqrt(np.mean(z[:, :2] ** 2)) == pytest.approx(1.0, abs=0.25)


def test_a_few_wrong_stars_change_little():
    fit = calibrate_optics(NominalOptics(SENT), stars(TRUE, wrong=0.03))
    sigma = np.sqrt(np.diagonal(fit.cov))
    assert abs(fit.camera.fx_px - TRUE.fx_px) < 4 * sigma[0]
    assert fit.residual_px == pytest.approx(0.15, rel=0.1)


def test_the_gain_shows_a_departure():
    assert calibrate_optics(NominalOptics(TRUE), stars(TRUE)).gain < 40
    assert calibrate_optics(NominalOptics(SENT), stars(TRUE)).gain > 1000


@pytest.mark.long
def test_catalogue_errors_are_no_departure():
    z, gains = [], []
    for seed in range(20):
        fit = calibrate_optics(NominalOptics(TRUE), same_stars_drifting(TRUE, seed, off_px=0.1))
        off = np.array([getattr(fit.camera, n) - getattr(TRUE, n) for n in OPTICS[:2]])
        z.append(off / np.sqrt(np.diagonal(fit.cov)[:2]))
        gains.append(fit.gain)
    assert np.sqrt(np.mean(np.square(z))) < 1.7  # 40 stars show their scatter so well
    assert max(gains) < 60


def test_too_few_stars_give_none():
    assert calibrate_optics(NominalOptics(SENT), stars(TRUE, n_frames=2)) is None
    none, nothing = np.empty(0), np.empty(0, int)
    assert (
        calibrate_optics(
            NominalOptics(SENT), StarImages(none, none, np.empty((0, 3)), nothing, nothing)
        )
        is None
    )


def test_stars_all_at_one_place_do_no_harm():
    u = np.tile([0.01, 0.02, 1.0], (100, 1))
    x, y = project(SENT, u)
    fit = calibrate_optics(
        NominalOptics(SENT),
        StarImages(x, y, u / np.linalg.norm(u[0]), np.arange(100) // 10, np.arange(100) % 10),
    )
    assert np.all(np.isfinite(fit.cov))
    assert fit.camera.fx_px == pytest.approx(SENT.fx_px, rel=0.02)


def sensor(field_deg, seed=0, **departure):
    """Return the calibration that a log tells and the true optics, of a field of this width."""
    f = 511.5 / np.tan(np.radians(field_deg / 2))
    sent = Camera(1024, 1024, f, f, 511.5, 511.5)
    scale = 1.0 + departure.pop("focal", 0.0)
    true = sent._replace(fx_px=scale * f, fy_px=scale * f)
    return sent, true._replace(**{n: getattr(true, n) + off for n, off in departure.items()})


def in_steps(sent, images):
    free = calibrate_optics(NominalOptics(sent), images)
    return calibrate_in_steps(NominalOptics(sent), images, free)


def attitude_errors(fit, images, n_frames):
    """Return the squares of some frames' attitude errors over their covariance, by axis.

    The attitudes are SciPy's, from the directions that the fitted optics give.
    """
    sigma_rad = 0.15 * fit.camera.pixel_rad
    offsets = np.searchsorted(images.frame, np.arange(n_frames + 1))
    u = unproject(fit.camera, images.x_px, images.y_px)[: offsets[-1]]
    each = np.full(len(u), sigma_rad)
    shared = shared_attitude_covariance(fit.camera, fit.cov, u, each, offsets)
    squares = []
    for k in range(n_frames):
        of = slice(offsets[k], offsets[k + 1])
        measured, true = u[of], images.u_sensor[of]
        off = Rotation.align_vectors(measured, true)[0].as_rotvec()
        information = np.eye(3) * len(measured) - measured.T @ measured
        own = sigma_rad**2 * np.linalg.inv(information)
        squares.append(off**2 / np.diagonal(own + shared[k]))
    return np.array(squares)


@pytest.mark.parametrize("field_deg", [8, 20])
@pytest.mark.parametrize("departure", [{"k1": -0.3}, {"focal": 0.02}, {"focal": 0.01, "k1": -1.0}])
def test_only_what_the_stars_demand_moves(field_deg, departure):
    sent, true = sensor(field_deg, **departure)
    fit = in_steps(sent, stars(true))
    for name in OPTICS[2:]:
        if name not in departure:
            assert getattr(fit.camera, name) == getattr(sent, name), name
    sigma = np.sqrt(np.diagonal(fit.cov))
    assert abs(fit.camera.fx_px - true.fx_px) < 4 * sigma[0]
    assert abs(fit.camera.k1 - true.k1) < 4 * sigma[4]


def test_the_principal_point_moves_where_the_stars_tell_it_from_a_rotation():
    moved = {}
    for field_deg in (8, 27):
        sent, true = sensor(field_deg, focal=0.02, cx_px=6.0, cy_px=-4.0)
        moved[field_deg] = in_steps(sent, stars(true))
    assert (moved[8].camera.cx_px, moved[8].camera.cy_px) == (sent.cx_px, sent.cy_px)
    assert moved[27].camera.cx_px == pytest.approx(true.cx_px, abs=2.0)
    assert moved[27].camera.cy_px == pytest.approx(true.cy_px, abs=2.0)


@pytest.mark.long
@pytest.mark.parametrize("field_deg", [8, 12, 20, 27])
def test_untold_optics_are_in_the_sigma_of_the_attitude(field_deg):
    rng = np.random.default_rng(field_deg)
    squares = []
    for seed in range(40):
        drawn = {name: rng.normal(0, 5.0) for name in ("cx_px", "cy_px")}
        drawn |= {name: rng.normal(0, 5e-4) for name in ("p1", "p2")}
        sent, true = sensor(field_deg, focal=rng.normal(0, 0.02), k1=rng.normal(0, 0.3), **drawn)
        images = stars(true, seed, turn=0.0)
        squares.append(attitude_errors(in_steps(sent, images), images, 5).mean(axis=0))
    ratio = np.mean(squares, axis=0)  # 40 sensors: known to a fifth
    assert np.all((ratio > 0.5) & (ratio < 1.6)), ratio
    assert 0.7 < ratio.mean() < 1.35

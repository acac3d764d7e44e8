"""Attributables: directions and rates of simulated passages are right, and their errors honest."""

import numpy as np
import pytest
from scenes.passages_of_one import Passages, passages_of_one

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import east_north
from epipole.tasks.algorithms.tracking.attributables import Attributables, attributables


def fitted(seen: Passages) -> Attributables:
    rows = np.stack([seen.bounds[:-1], seen.bounds[1:]], axis=1)
    return attributables(rows, np.zeros(len(rows)), seen.time_s, seen.u, seen.cov)


def errors(found: Attributables, seen: Passages) -> np.ndarray:
    """Return the errors (t, 4): east, north, and of their rates."""
    basis = east_north(found.u)
    both = (found.u - seen.true_u, found.w - seen.true_w)
    off = [np.einsum("nij,nj->ni", basis, d) for d in both]
    return np.concatenate(off, axis=1)


def nees(found: Attributables, seen: Passages) -> np.ndarray:
    e = errors(found, seen)
    return np.einsum("ni,nij,nj->n", e, np.linalg.inv(found.cov), e)


@pytest.mark.parametrize("far", [False, True])
@pytest.mark.parametrize(
    ("seconds", "rate_hz", "sigma_arcsec"),
    [(1, 5, 2.0), (3, 5, 20.0), (10, 2, 2.0), (30, 2, 20.0), (60, 1, 2.0), (180, 1, 20.0)],
)
def test_covariances_are_honest(far, seconds, rate_hz, sigma_arcsec):
    seen = passages_of_one(5, 1500, seconds, rate_hz, sigma_arcsec, far=far)
    squares = nees(fitted(seen), seen)
    # 1-sigma of the mean of 1,500 with four degrees of freedom each: 0.018.
    assert 0.88 < squares.mean() / 4 < 1.1
    assert (squares < 13.28).mean() > 0.97  # 99 %


def test_an_error_that_all_frames_share_adds_to_the_direction_alone():
    seen = passages_of_one(6, 1500, 10, 2, 2.0, far=True)
    rng = np.random.default_rng(1)
    tracklet = np.repeat(np.arange(1500), np.diff(seen.bounds))
    turn = 5.0 * ARCSEC * rng.normal(size=(1500, 3))[tracklet]
    turned = seen.u + np.cross(turn, seen.u)
    shifted = seen._replace(u=turned / np.linalg.norm(turned, axis=1, keepdims=True))
    found = fitted(shifted)
    e, cov = errors(found, shifted), found.cov.copy()
    cov[:, [0, 1], [0, 1]] += (5.0 * ARCSEC) ** 2
    squares = np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov), e)
    assert 0.9 < squares.mean() / 4 < 1.1


def test_without_noise_direction_and_rate_are_exact():
    seen = passages_of_one(7, 200, 10, 5, 1e-4, far=False)
    e = errors(fitted(seen), seen)
    slow = np.linalg.norm(seen.true_w, axis=1) < np.radians(0.5)
    assert np.abs(e[slow, :2]).max() < 0.01 * ARCSEC
    assert np.abs(e[slow, 2:]).max() < 0.01 * ARCSEC


@pytest.mark.parametrize("n", [1, 2, 3])
def test_few_detections_are_enough(n):
    seen = passages_of_one(8, 1, 1, 5, 2.0, far=True)
    rows = np.array([[0, n], [n, n]])
    found = attributables(rows, np.array([0.0, 0.0]), seen.time_s, seen.u, seen.cov)
    assert np.isnan(found.cov[1]).all()
    assert np.arccos(np.clip(found.u[0] @ seen.true_u[0], -1, 1)) < np.radians(0.5)
    if n > 1:
        assert np.linalg.eigvalsh(found.cov[0]).min() > 0


def test_near_the_pole_east_and_north_are_those_of_the_direction():
    seen = passages_of_one(9, 300, 3, 5, 2.0, far=False)
    turn = [np.linalg.qr(np.random.default_rng(k).normal(size=(3, 3)))[0] for k in range(3)]
    for R in turn:
        R = R * np.sign(np.linalg.det(R))
        moved = Passages(
            seen.bounds, seen.time_s, seen.u @ R.T, R @ seen.cov @ R.T, seen.true_u @ R.T,
            seen.true_w @ R.T,
        )  # fmt: skip
        np.testing.assert_allclose(nees(fitted(moved), moved), nees(fitted(seen), seen), rtol=1e-4)
    at_pole = np.array([[1e-9, 0.0, 1.0]])
    u = np.repeat(at_pole, 3, axis=0)
    found = attributables(
        np.array([[0, 3]]), np.array([0.0]), np.array([-1.0, 0.0, 1.0]), u, seen.cov[:3]
    )
    assert np.isfinite(found.cov).all()


@pytest.mark.parametrize("off_rad", [0.0, 1e-17, 1e-6])
def test_at_the_pole_errors_are_as_large_as_elsewhere(off_rad):
    t = np.array([-1.0, 0.0, 1.0])
    u = np.stack([1e-4 * t + off_rad, 0 * t, np.ones(3)], axis=1)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    found = attributables(
        np.array([[0, 3]]), np.zeros(1), t, u, np.tile(1e-10 * np.eye(3), (3, 1, 1))
    )
    np.testing.assert_allclose(np.linalg.eigvalsh(found.cov[0, :2, :2]), 1e-10 / 3, rtol=0.01)

"""Epipolar geometry: against the fundamental matrix of the published method."""

import numpy as np
from scenes.two_sensors import GEO, R_1, R_2, attitude, look

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.covariances import centroid_covariance
from epipole.tasks.algorithms.geometry.directions import skew
from epipole.tasks.algorithms.geometry.epipolar import (
    UncertainSight,
    epipolar_angle,
    epipolar_sigma,
)


def test_two_sights_of_one_object_have_no_epipolar_distance():
    assert abs(epipolar_angle(R_1, look(R_1, GEO), R_2, look(R_2, GEO))) < 1e-3 * ARCSEC


def test_it_is_the_distance_to_the_line_of_the_fundamental_matrix():
    # Huang, Zhang, Feng: F = M2^-T R_12 S M1^-1 with S the skew matrix of t = r_1 (O_2 - O_1).
    f = 14666.23
    M = np.array([[f, 0, 252.44], [0, f, 235.33], [0, 0, 1.0]])
    A_1, A_2 = attitude(look(R_1, GEO), 1), attitude(look(R_2, GEO), 2)
    off = GEO + np.array([200.0, -300.0, 400.0])
    p_1 = M @ (A_1 @ look(R_1, GEO))
    p_2 = M @ (A_2 @ look(R_2, off))
    F = np.linalg.inv(M).T @ (A_2 @ A_1.T) @ skew(A_1 @ (R_2 - R_1)) @ np.linalg.inv(M)
    line = F @ (p_1 / p_1[2])
    distance = abs(p_2 / p_2[2] @ line) / np.hypot(line[0], line[1])
    angle = epipolar_angle(R_1, look(R_1, GEO), R_2, look(R_2, off))
    assert distance > 5
    np.testing.assert_allclose(abs(angle) * f, distance, rtol=1e-3)  # the field's curvature


def test_its_sigma_is_honest_over_many_trials():
    rng = np.random.default_rng(5)
    n, sigma, place = 4000, 3 * ARCSEC, 0.1
    r_1, r_2 = (r + rng.normal(size=(n, 3)) * place for r in (R_1, R_2))
    u_1, u_2 = np.tile(look(R_1, GEO), (n, 1)), np.tile(look(R_2, GEO), (n, 1))
    cov = centroid_covariance(u_1, np.full(n, sigma)), centroid_covariance(u_2, np.full(n, sigma))
    noisy_1 = u_1 + np.einsum("nij,nj->ni", cov[0] / sigma, rng.normal(size=(n, 3)))
    noisy_2 = u_2 + np.einsum("nij,nj->ni", cov[1] / sigma, rng.normal(size=(n, 3)))
    angle = epipolar_angle(r_1, look(0, noisy_1), r_2, look(0, noisy_2))
    on_plane = np.tile(sigma**2 * np.eye(2), (n, 1, 1))
    first = UncertainSight(R_1, u_1, on_plane, np.array(place))
    second = UncertainSight(R_2, u_2, on_plane, np.array(place))
    claimed = epipolar_sigma(first, second, GEO)
    assert abs(np.std(angle / claimed) - 1) < 0.05


def test_a_direction_along_the_baseline_has_no_plane():
    along = look(R_1, R_2)
    assert epipolar_angle(R_1, along, R_2, look(R_2, GEO)) == 0.0

"""Rotations, against SciPy's."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation, Slerp

from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import (
    apparent_positions,
    canonical,
    conjugate,
    interpolate_quaternions,
    matrix_from_quaternion,
    multiply,
    quaternion_from_matrix,
    quaternion_from_rotation_vector,
    rotation_vector_from_quaternion,
    skew,
)

seeds = settings(deadline=None), given(seed=st.integers(0, 2**32 - 1))


def for_any_seed(test):
    return seeds[0](seeds[1](test))


@for_any_seed
def test_matrices_of_quaternions_are_scipys(seed):
    r = Rotation.random(20, random_state=seed)
    np.testing.assert_allclose(matrix_from_quaternion(r.as_quat()), r.as_matrix(), atol=1e-14)


@for_any_seed
def test_quaternions_of_matrices_are_scipys(seed):
    r = Rotation.random(20, random_state=seed)
    want = canonical(r.as_quat())
    np.testing.assert_allclose(quaternion_from_matrix(r.as_matrix()), want, atol=1e-14)


def test_half_turns_survive_the_way_to_quaternions_and_back():
    R = np.array([np.diag(d) for d in ([1.0, -1, -1], [-1.0, 1, -1], [-1.0, -1, 1], [1.0, 1, 1])])
    np.testing.assert_allclose(matrix_from_quaternion(quaternion_from_matrix(R)), R, atol=1e-15)


@for_any_seed
def test_products_of_quaternions_are_products_of_matrices(seed):
    q, p = Rotation.random(2, random_state=seed).as_quat()
    got = matrix_from_quaternion(multiply(q, p))
    want = matrix_from_quaternion(q) @ matrix_from_quaternion(p)
    np.testing.assert_allclose(got, want, atol=1e-14)
    np.testing.assert_allclose(
        matrix_from_quaternion(conjugate(q)), matrix_from_quaternion(q).T, atol=1e-15
    )


@for_any_seed
def test_rotation_vectors_are_scipys_from_tiny_to_half_a_turn(seed):
    rng = np.random.default_rng(seed)
    v = rng.normal(size=(10, 3))
    v *= (10.0 ** rng.uniform(-12, 0.49, 10) / np.linalg.norm(v, axis=1))[:, None]
    q = quaternion_from_rotation_vector(v)
    want = canonical(Rotation.from_rotvec(v).as_quat())
    np.testing.assert_allclose(canonical(q), want, atol=1e-15)
    np.testing.assert_allclose(rotation_vector_from_quaternion(q), v, rtol=1e-9, atol=1e-22)


def test_no_rotation_has_a_zero_vector():
    np.testing.assert_array_equal(
        rotation_vector_from_quaternion(np.array([[0.0, 0, 0, 1]])), [[0, 0, 0]]
    )
    np.testing.assert_array_equal(quaternion_from_rotation_vector(np.zeros((1, 3))), [[0, 0, 0, 1]])


@for_any_seed
def test_skew_is_the_cross_product(seed):
    a, v = np.random.default_rng(seed).normal(size=(2, 5, 3))
    np.testing.assert_allclose(np.einsum("nij,nj->ni", skew(v), a), np.cross(v, a), atol=1e-14)


@for_any_seed
def test_interpolation_is_scipys_slerp_whatever_the_signs(seed):
    rng = np.random.default_rng(seed)
    steps = Rotation.from_rotvec(rng.normal(0, 0.3, (6, 3)))
    path = [Rotation.random(random_state=seed)]
    for step in steps:
        path.append(step * path[-1])
    times, q = np.arange(7.0), Rotation.concatenate(path).as_quat()
    at = rng.uniform(0, 6, 20)
    got = interpolate_quaternions(times, q * rng.choice([-1, 1], (7, 1)), at)
    want = canonical(Slerp(times, Rotation.from_quat(q))(at).as_quat())
    np.testing.assert_allclose(got, want, atol=1e-9)


def test_one_attitude_holds_for_all_times():
    q = np.array([[0.0, 0.0, 0.6, -0.8]])
    got = interpolate_quaternions(np.array([5.0]), q, np.array([1.0, 9.0]))
    np.testing.assert_allclose(got, [[0, 0, -0.6, 0.8]] * 2)


def test_a_far_sensor_sees_an_object_where_it_was_earlier():
    x, v = np.array([[7000.0, 0.0, 0.0]] * 2), np.array([[0.0, 7.5, 0.0]] * 2)
    r = np.array([[8000.0, 0.0, 0.0], [-35000.0, 0.0, 0.0]])
    light_s = np.full(2, 1000.0 / SPEED_OF_LIGHT_KM_S)  # where the near sensor sees it
    seen = apparent_positions(x, v, light_s, r)
    np.testing.assert_allclose(seen[0], x[0], atol=1e-9)
    np.testing.assert_allclose(seen[1] - x[1], [0.0, -7.5 * 41000.0 / SPEED_OF_LIGHT_KM_S, 0.0])

"""The camera, against OpenCV's printed formulas."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from epipole.tasks.algorithms.geometry.camera import (
    Camera,
    distort,
    fold_radius,
    inside,
    pixel_angle,
    project,
    slopes,
    undistort,
    unproject,
)

# The six-sensor log's distortion, stronger, and with every coefficient at work.
CAMERA = Camera(1024, 768, 1500.0, 1480.0, 508.4, 391.3, -0.21, 0.08, 1.2e-3, -7e-4, 0.015)


def _opencv(camera, x, y):
    """OpenCV 4 documentation, calib3d, "Detailed Description", one point at a time."""
    r2 = x**2 + y**2
    k = 1 + camera.k1 * r2 + camera.k2 * r2**2 + camera.k3 * r2**3
    return (
        x * k + 2 * camera.p1 * x * y + camera.p2 * (r2 + 2 * x**2),
        y * k + camera.p1 * (r2 + 2 * y**2) + 2 * camera.p2 * x * y,
    )


@settings(deadline=None)
@given(st.floats(-0.4, 0.4), st.floats(-0.3, 0.3))
def test_distortion_is_opencvs_and_undistortion_its_inverse(x, y):
    got = distort(CAMERA, np.array([x]), np.array([y]))
    np.testing.assert_allclose(np.ravel(got), _opencv(CAMERA, x, y), atol=1e-15)
    np.testing.assert_allclose(np.ravel(undistort(CAMERA, *got)), [x, y], atol=1e-12)


def test_undistortion_without_distortion_changes_nothing():
    plain = CAMERA._replace(k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0)
    x = np.array([0.1, -0.2])
    np.testing.assert_array_equal(undistort(plain, x, x), [x, x])


def test_the_principal_point_is_the_boresight_and_axes_point_right_and_down():
    u = unproject(CAMERA, np.array([508.4, 608.4, 508.4]), np.array([391.3, 391.3, 491.3]))
    np.testing.assert_allclose(u[0], [0, 0, 1], atol=1e-15)
    assert u[1, 0] > 0.06
    assert u[2, 1] > 0.06


@settings(deadline=None)
@given(st.floats(0, 1023), st.floats(0, 767))
def test_projection_undoes_unprojection(x, y):
    got = project(CAMERA, unproject(CAMERA, np.array([x]), np.array([y])))
    np.testing.assert_allclose(np.ravel(got), [x, y], atol=1e-7)


def test_directions_behind_the_camera_have_no_place():
    x, y = project(CAMERA, np.array([[0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]))
    assert np.isnan(x).all()
    assert not inside(CAMERA, x, y).any()


def test_the_image_reaches_half_a_pixel_beyond_the_outer_pixels_middles():
    edge = np.array([-0.5, -0.51, 1023.4, 1023.5])
    np.testing.assert_array_equal(inside(CAMERA, edge, np.zeros(4)), [True, False, True, False])


@settings(deadline=None)
@given(st.floats(0, 1022), st.floats(0, 766))
def test_a_pixel_spans_the_root_of_its_solid_angle(x, y):
    u = unproject(CAMERA, np.array([x, x + 0.01, x]), np.array([y, y, y + 0.01]))
    solid = np.linalg.norm(np.cross(u[1] - u[0], u[2] - u[0])) / 1e-4
    assert pixel_angle(CAMERA, u[:1])[0] == pytest.approx(np.sqrt(solid), rel=1e-3)


def test_the_half_diagonal_reaches_the_farthest_corner():
    plain = Camera(100, 100, 50.0, 50.0, 49.5, 49.5)
    assert plain.half_diagonal_rad == pytest.approx(np.arctan(np.sqrt(2)))
    assert plain.pixel_rad == pytest.approx(1 / 50)


# 62 degrees along the sides. The distortion folds at 1.05, between the sides (0.6) and the corners.
WIDE = Camera(1024, 1024, 852.1, 852.1, 511.5, 511.5, -0.3)


def test_before_the_fold_of_a_wide_lens_undistortion_is_the_inverse_and_beyond_it_is_nothing():
    fold = fold_radius(WIDE)
    assert fold == pytest.approx(1 / np.sqrt(0.9), abs=2e-3)
    r, turn = np.meshgrid(np.linspace(0, 0.99 * fold, 60), np.linspace(0, 6, 31))
    x, y = (r * np.cos(turn)).ravel(), (r * np.sin(turn)).ravel()
    np.testing.assert_allclose(undistort(WIDE, *distort(WIDE, x, y)), [x, y], atol=1e-6)
    u = unproject(WIDE, np.array([0.0, 0.0, 1023.0]), np.array([0.0, 511.5, 1023.0]))
    assert np.isfinite(u[:, 2]).tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("f_px", "terms"),
    [
        (1547.0, (-0.79, -3.98, 9.46)),
        (1721.0, (-0.77, -14.1, 46.5)),
        (1085.0, (-0.365, -1.03, 1.04)),
    ],
)
def test_where_an_image_hardly_grows_towards_its_corners_undistortion_is_the_inverse(f_px, terms):
    k1, k2, k3 = terms
    lens = Camera(1024, 1024, f_px, f_px, 511.5, 511.5, k1=k1, k2=k2, k3=k3)
    assert fold_radius(lens) == np.inf
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0.0, 1023.0, 41)] * 2))
    got = project(lens, unproject(lens, x, y))
    np.testing.assert_allclose(got, [x, y], atol=1e-7)


def test_where_tangential_terms_fold_the_image_there_is_no_direction():
    lens = WIDE._replace(k1=0.0, p1=-0.3)
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(0.0, 1023.0, 41)] * 2))
    u = unproject(lens, x, y)
    known = np.isfinite(u[:, 2])
    assert 0.5 < known.mean() < 1.0
    np.testing.assert_allclose(project(lens, u[known]), [x[known], y[known]], atol=1e-4)


def test_a_camera_that_does_not_fold_has_no_fold():
    assert fold_radius(WIDE._replace(k1=0.2)) == np.inf


# 85 degrees along the sides, 120 to the corners.
FISHEYE = Camera(
    1024, 1024, 690.0, 690.0, 500.0, 520.0, -0.02, 0.006, 0.0, 0.0, -0.002, 3e-4, fisheye=True
)


def _opencv_fisheye(camera, x, y):
    """OpenCV 4 documentation, fisheye, "Detailed Description", one point at a time."""
    r = math.hypot(x, y)
    theta = math.atan(r)
    k = camera.k1, camera.k2, camera.k3, camera.k4
    bent = theta * (1 + sum(c * theta ** (2 * n) for n, c in enumerate(k, start=1)))
    return x * bent / r, y * bent / r


@settings(deadline=None)
@given(st.floats(1e-6, 1.7), st.floats(0, 6.3))
def test_a_fisheye_is_opencvs_and_undistortion_its_inverse(r, turn):
    x, y = r * math.cos(turn), r * math.sin(turn)
    got = distort(FISHEYE, np.array([x]), np.array([y]))
    np.testing.assert_allclose(np.ravel(got), _opencv_fisheye(FISHEYE, x, y), atol=1e-12)
    np.testing.assert_allclose(np.ravel(undistort(FISHEYE, *got)), [x, y], rtol=1e-8, atol=1e-12)


@pytest.mark.parametrize("camera", [CAMERA, FISHEYE, FISHEYE._replace(p1=2e-3, p2=-1e-3)])
def test_slopes_are_the_derivatives_of_the_distortion(camera):
    x, y = np.array([0.0, 3e-5, 0.3, -0.5]), np.array([0.0, 4e-5, -0.2, 0.4])
    step = 1e-6
    by_x = (np.stack(distort(camera, x + step, y)) - distort(camera, x - step, y)) / (2 * step)
    by_y = (np.stack(distort(camera, x, y + step)) - distort(camera, x, y - step)) / (2 * step)
    want = [by_x[0], by_y[0], by_x[1], by_y[1]]
    np.testing.assert_allclose(slopes(camera, x, y), want, atol=1e-8)


@pytest.mark.parametrize("xy", [(500.0, 520.0), (3.0, 8.0), (1000.0, 400.0)])
def test_a_pixel_of_a_fisheye_spans_the_root_of_its_solid_angle(xy):
    x, y = xy
    u = unproject(FISHEYE, np.array([x, x + 0.01, x]), np.array([y, y, y + 0.01]))
    solid = np.linalg.norm(np.cross(u[1] - u[0], u[2] - u[0])) / 1e-4
    assert pixel_angle(FISHEYE, u[:1])[0] == pytest.approx(np.sqrt(solid), rel=1e-3)


@pytest.mark.parametrize("fisheye", [False, True])
def test_the_middles_of_the_sides_are_at_the_tangents_of_half_the_field(fisheye):
    camera = Camera(1000, 800, 500.0, -500.0, 499.5, 399.5, fisheye=fisheye)
    x, y, z = unproject(camera, np.array([999.5, 499.5]), np.array([399.5, -0.5])).T
    assert camera.half_field == pytest.approx((x[0] / z[0], abs(y[1] / z[1])))
    assert Camera(4000, 4000, 500.0, 500.0, 1999.5, 1999.5, fisheye=True).half_field[0] > 10


def test_the_field_of_a_fisheye_is_its_image_over_the_focal_length():
    plain = Camera(100, 50, 100.0, 100.0, 49.5, 24.5, fisheye=True)
    assert plain.field_deg == pytest.approx((np.degrees(1.0), np.degrees(0.5)))
    assert plain.half_diagonal_rad == pytest.approx(np.hypot(0.5, 0.25))
    # No direction in front of the camera is that far from the boresight.
    assert np.isnan(unproject(plain, np.array([300.0]), np.array([24.5]))).all()

"""The published association: its matrix, its table and its positions, and where it fails."""

import numpy as np
import pytest
from scenes.two_sensors import GEO, R_1, R_2, attitude, look

from epipole.tasks.algorithms.association.epipolar_lines import (
    associate_by_lines,
    fundamental_matrix,
    intersect_sights,
    line_distances,
    pair_images,
    pair_points,
    view_table,
)

METRE = 1e-3  # km
M = np.array([[7331.0, 0, 252.44], [0, 7331.0, 235.33], [0, 0, 1.0]])


def image(R, r, x):
    p = (x - r) @ R.T @ M.T
    return p[:, :2] / p[:, 2:]


def test_the_two_images_of_a_point_satisfy_the_fundamental_matrix():
    A_1, A_2 = attitude(look(R_1, GEO), 1), attitude(look(R_2, GEO), 2)
    x = GEO + np.random.default_rng(0).normal(size=(50, 3)) * 300
    F = fundamental_matrix(M, A_1, R_1, M, A_2, R_2)
    distance = line_distances(F, image(A_1, R_1, x), image(A_2, R_2, x))
    assert np.diag(distance).max() < 1e-6  # px
    assert distance[~np.eye(50, dtype=bool)].mean() > 10


def test_the_distance_is_that_of_a_point_shifted_across_its_line():
    A_1, A_2 = attitude(look(R_1, GEO), 1), attitude(look(R_2, GEO), 2)
    F = fundamental_matrix(M, A_1, R_1, M, A_2, R_2)
    p_1, p_2 = image(A_1, R_1, GEO[None]), image(A_2, R_2, GEO[None])
    a, b, _ = F @ np.append(p_1[0], 1.0)
    across, along = np.array([a, b]) / np.hypot(a, b), np.array([-b, a]) / np.hypot(a, b)
    assert line_distances(F, p_1, p_2 + 3 * across)[0, 0] == pytest.approx(3, abs=1e-6)
    assert line_distances(F, p_1, p_2 + 3 * along)[0, 0] == pytest.approx(0, abs=1e-6)


def test_the_nearest_wins_and_every_point_has_one_partner_at_most():
    distance = np.array([[3.0, 1.0, 9.0], [0.5, 0.8, 9.0], [9.0, 9.0, 9.0]])
    assert pair_points(distance, 5.0).tolist() == [[0, 1], [1, 0]]
    assert pair_points(distance, 0.9).tolist() == [[1, 0]]
    assert pair_points(np.zeros((0, 3)), 5.0).shape == (0, 2)


def test_a_point_joins_a_row_only_if_it_is_paired_with_all_its_points():
    pairs = {
        (0, 1): np.array([[0, 0], [1, 1]]),
        (0, 2): np.array([[0, 0], [1, 1]]),
        (1, 2): np.array([[0, 0]]),  # 1-1 is missing
    }
    assert view_table([2, 2, 2], pairs).tolist() == [[0, 0, 0], [1, 1, -1]]
    assert view_table([2, 2, 2], {}).shape == (0, 3)


def test_lines_of_sight_meet_at_the_point():
    r = np.array([R_1, R_2, [0.0, -7000.0, 2000.0], [3000.0, 0, -6500]])
    position, n = intersect_sights(r, look(r, GEO))
    assert n == 6
    assert np.linalg.norm(position - GEO) < METRE


def test_a_wrong_line_of_sight_spoils_four_sensors_but_not_many():
    # The 3-sigma rule cannot fire below 11 intersections.
    rng = np.random.default_rng(3)
    error = []
    for n in (4, 12):
        out = rng.normal(size=(n, 3))
        r = 7000 * out / np.linalg.norm(out, axis=1, keepdims=True)
        u = look(r, GEO)
        u[0] = look(r[0], GEO + np.array([0.0, 0.0, 3000.0]))
        position, used = intersect_sights(r, u)
        error.append(np.linalg.norm(position - GEO))
        assert (used == n * (n - 1) // 2) == (n == 4)
    assert error[0] > 100


def test_parallel_lines_of_sight_give_no_position():
    position, n = intersect_sights(np.array([R_1, R_2]), np.array([look(R_1, GEO)] * 2))
    assert n == 0
    assert np.isnan(position).all()


def test_tracklets_are_grouped_as_their_points_are_paired():
    from scenes.tracklet_scenes import Scene, judge

    scene = Scene(3, 4).objects(6).strays(2)
    focal_px = np.full(4, 256 / np.tan(np.radians(1.0)))
    precision, recall = judge(scene, associate_by_lines(scene.samples(), focal_px, 2.0))
    assert precision > 0.85
    assert recall > 0.5
    crowded = Scene(3, 4).objects(20).strays(50)
    precision, _ = judge(crowded, associate_by_lines(crowded.samples(), focal_px, 10.0))
    assert precision < 0.7  # the false points that happen to lie on a line


@pytest.mark.parametrize("apart_km", [0.0, 0.001])
def test_two_cameras_of_one_satellite_do_not_spoil_the_table(apart_km):
    """Their baseline shows no lines. Each object has the third sensor and one of the two."""
    rng = np.random.default_rng(1)
    x = GEO + rng.normal(size=(8, 3)) * 200
    r_km = np.array([R_1, R_1 + apart_km, R_2])
    R = np.stack([attitude(look(r, GEO), k) for k, r in enumerate(r_km)])
    shown = [rng.permutation(8) for _ in r_km]
    images = [
        image(A, r, x[order]) + rng.normal(size=(8, 2)) * 0.05
        for A, r, order in zip(R, r_km, shown, strict=True)
    ]
    table = view_table([8] * 3, pair_images(images, np.stack([M] * 3), R, r_km, 1.0))
    right = [
        len({int(shown[k][point]) for k, point in enumerate(row) if point >= 0}) for row in table
    ]
    assert right.count(1) >= 7
    assert right.count(1) == len(right)

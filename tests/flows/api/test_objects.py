"""Objects from the views of one instant, against their true places."""

import numpy as np
import pytest

from epipole.flows import api
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import quaternion_from_matrix, tangent_basis

CAMERA = api.Camera(512, 512, 14666.0, 14666.0, 255.5, 255.5)
CENTRE_KM = np.array([42164.0, 0.0, 0.0])
SIGMA = 1.0 * ARCSEC


def scene(seed, n_sensors=4, n_objects=8):
    """Return views in which objects come in random order, their places and the true objects."""
    rng = np.random.default_rng(seed)
    there_km = CENTRE_KM + rng.normal(size=(n_objects, 3)) * [20.0, 200.0, 200.0]
    views, who = [], []
    for _ in range(n_sensors):
        place = rng.normal(size=3)
        place[0] = abs(place[0])  # the Earth is in nobody's way
        place *= 7000.0 / np.linalg.norm(place)
        boresight = (CENTRE_KM - place) / np.linalg.norm(CENTRE_KM - place)
        R = np.vstack([tangent_basis(boresight), boresight])
        order = rng.permutation(n_objects)
        u = (there_km[order] - place) / np.linalg.norm(there_km[order] - place, axis=1)[:, None]
        u = u + np.einsum("na,nai->ni", rng.normal(size=(n_objects, 2)) * SIGMA, tangent_basis(u))
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        q = quaternion_from_matrix(R[None])[0]
        views.append(api.View(u, SIGMA**2 * np.eye(2), place, 1e-3, q, CAMERA))
        who.append(order)
    return views, there_km, who


def test_objects_are_found_and_placed_as_their_covariances_say():
    chi2, n_right, n_all = [], 0, 0
    for seed in range(6):
        views, there_km, who = scene(seed)
        found = api.associate(views)
        places = api.triangulate(views, found.objects)
        assert len(places.r_gcrf_km) == len(found.log_odds)
        for k in range(len(found.log_odds)):
            members = [who[s][of == k] for s, of in enumerate(found.objects)]
            names = np.concatenate(members)
            n_all += 1
            n_right += len(set(names.tolist())) == 1
            error = places.r_gcrf_km[k] - there_km[names[0]]
            chi2.append(error @ np.linalg.solve(places.cov_km2[k], error))
    assert n_all >= 0.95 * 48
    assert n_right == n_all
    assert np.mean(chi2) == pytest.approx(3.0, abs=5 * np.sqrt(6 / n_all))


def test_lines_of_one_object_need_no_labels():
    views, there_km, _ = scene(1, n_objects=1)
    bare = [api.View(view.u_icrs, view.cov_rad2, view.position_km) for view in views]
    found = api.triangulate(bare)
    assert found.r_gcrf_km.shape == (1, 3)
    assert np.linalg.norm(found.r_gcrf_km[0] - there_km[0]) < 5.0
    assert np.concatenate(found.used).all()


def test_a_line_that_does_not_fit_is_left_out():
    views, _, _ = scene(2, n_objects=1)
    u = views[0].u_icrs + np.array([0.0, 0.0, 100 * ARCSEC])
    views[0] = views[0]._replace(u_icrs=u / np.linalg.norm(u))
    found = api.triangulate(views)
    assert [bool(used[0]) for used in found.used] == [False, True, True, True]


@pytest.mark.parametrize("n_sensors", [2, 3, 4])
def test_lines_without_error_meet_where_the_object_is(n_sensors):
    views, there_km, _ = scene(3, n_sensors, n_objects=1)
    lines = there_km[0] - [view.position_km for view in views]
    u = lines / np.linalg.norm(lines, axis=1, keepdims=True)
    exact = [
        view._replace(u_icrs=u[k : k + 1], cov_rad2=np.zeros((2, 2)), position_sigma_km=0.0)
        for k, view in enumerate(views)
    ]
    found = api.triangulate(exact)
    np.testing.assert_allclose(found.r_gcrf_km, there_km, rtol=0.0, atol=1e-6)
    assert np.sqrt(np.trace(found.cov_km2[0])) < 1e-5
    assert np.concatenate(found.used).all()
    if n_sensors > 2:
        assert [of.tolist() for of in api.associate(exact).objects] == [[0]] * n_sensors


@pytest.mark.parametrize("limit", [0.0, -3.0, np.nan])
def test_a_limit_of_residuals_is_above_0(limit):
    views, _, _ = scene(2, n_objects=1)
    with pytest.raises(ValueError, match="reject_sigma: is "):
        api.triangulate(views, reject_sigma=limit)


def test_no_views_give_no_objects():
    assert api.associate([]).objects == []
    assert api.triangulate([], []).r_gcrf_km.shape == (0, 3)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"u_icrs": np.zeros((2, 2))}, r"views\[0\].u_icrs: has shape \(2, 2\), expected \(n, 3\)"),
        ({"u_icrs": np.ones((2, 3))}, r"views\[0\].u_icrs: are no unit vectors"),
        ({"cov_rad2": np.ones(3)}, r"views\[0\].cov_rad2: has shape \(3,\), expected \(8, 2, 2\)"),
        (
            {"cov_rad2": -np.eye(2)},
            r"views\[0\].cov_rad2: \[\[-1.0, -0.0\], .* is not a covariance",
        ),
        ({"cov_rad2": np.full((2, 2), np.nan)}, r"views\[0\].cov_rad2: .* is not a covariance"),
        ({"cov_rad2": [[1.0, 2.0], [2.0, 1.0]]}, r"views\[0\].cov_rad2: .* is not a covariance"),
        ({"cov_rad2": [[1.0, 0.5], [0.0, 1.0]]}, r"views\[0\].cov_rad2: .* is not a covariance"),
        ({"position_km": [7e3]}, r"views\[0\].position_km: has shape \(1,\), expected \(3,\)"),
        ({"position_km": [7e6, 0.0, 0.0]}, r"position_km: 7e\+06 km from .*; is it in m\?"),
        ({"position_km": [np.nan] * 3}, r"views\[0\].position_km: is .*, expected numbers"),
        ({"position_sigma_km": None}, r"views\[0\].position_sigma_km: is nan, expected 0 or"),
        ({"position_sigma_km": -0.05}, r"views\[0\].position_sigma_km: is -0.05, expected 0 or"),
        ({"attitude_xyzw": np.full(4, np.nan)}, r"views\[0\].attitude_xyzw: has length nan"),
        ({"attitude_xyzw": np.ones(4)}, r"views\[0\].attitude_xyzw: has length 2, expected a unit"),
        ({"camera": None}, r"views\[0\]: has no attitude or no camera"),
    ],
)
def test_wrong_views_are_named(change, message):
    views, _, _ = scene(0)
    with pytest.raises(ValueError, match=message):
        api.associate([views[0]._replace(**change), *views[1:]])


def test_wrong_labels_are_named():
    views, _, who = scene(0)
    with pytest.raises(ValueError, match="has 8 directions; `objects` has to say"):
        api.triangulate(views)
    with pytest.raises(ValueError, match="objects: has 1 entries, expected 4"):
        api.triangulate(views, who[:1])
    with pytest.raises(ValueError, match=r"objects\[0\]: has shape \(1,\), expected \(8,\)"):
        api.triangulate(views, [[0], *who[1:]])
    with pytest.raises(ValueError, match=r"velocity_km_s: has shape \(3,\), expected \(8, 3\)"):
        api.triangulate(views, who, velocity_km_s=[0.0, 0.0, 0.0])


def test_objects_that_are_not_numbered_from_0_on_are_refused():
    view = api.View([[1.0, 0.0, 0.0]], 1e-12 * np.eye(2), [7000.0, 0.0, 0.0])
    for label, message in ((10_000_000, "number the objects from 0 on"), (0.5, "expected whole")):
        with pytest.raises(ValueError, match=message):
            api.triangulate([view, view], [[label], [label]])
    assert api.triangulate([view, view], [[12], [12]]).r_gcrf_km.shape == (13, 3)

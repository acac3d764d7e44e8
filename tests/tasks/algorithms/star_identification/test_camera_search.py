"""Camera search: focal length and handedness are found from one frame, and nothing in noise."""

import numpy as np
import pytest

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.bridge import array
from epipole.tasks.algorithms.geometry.camera import Camera, inside, mirrored, project, unproject
from epipole.tasks.algorithms.geometry.directions import canonical, matrix_from_quaternion
from epipole.tasks.algorithms.star_identification import camera_search
from epipole.tasks.algorithms.star_identification.camera_search import (
    ImageFrame,
    agreeing_camera,
    find_cameras,
)
from epipole.tasks.algorithms.star_identification.frame import MatchSettings
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue

pytestmark = pytest.mark.long

TRUE = Camera(1024, 1024, 4850.0, 4850.0, 505.0, 517.0, k1=-0.1, p1=1e-3)  # 12 degrees
DAY = 17_987  # 2019-04-01
MATCHING = MatchSettings(3.7, -np.log(1e-5), 0.5, np.nan)


@pytest.fixture(scope="module")
def catalogue():
    return Catalogue(read_hipparcos())


@pytest.fixture(scope="module")
def skies_of(catalogue):
    return lambda pixel_rad: CachedSkies(catalogue, DAY, pixel_rad, 2.0)


def frame(camera, seed, flux=True, strays=5, limit=6.3):
    """A frame of Hipparcos' stars and strays in a random direction, brightest first."""
    rng = np.random.default_rng(seed)
    stars = read_hipparcos()
    bright = array(stars, "magnitude") < limit
    ra, dec = (np.radians(array(stars, name)[bright]) for name in ("ra_deg", "dec_deg"))
    u = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    R = matrix_from_quaternion(canonical(rng.normal(size=(1, 4))))[0]
    x, y = project(camera, u @ R.T)
    seen = inside(camera, x, y) & (u @ R[2] > 0.9)
    magnitude = array(stars, "magnitude")[bright][seen] + rng.normal(0, 0.2, seen.sum())
    x = np.concatenate([x[seen], rng.uniform(0, 1023, strays)]) + rng.normal(
        0, 0.2, seen.sum() + strays
    )
    y = np.concatenate([y[seen], rng.uniform(0, 1023, strays)])
    magnitude = np.concatenate([magnitude, rng.uniform(3, limit, strays)])
    order = np.argsort(magnitude)
    if not flux:
        order, magnitude = rng.permutation(len(order)), np.full(len(order), np.nan)
    return ImageFrame(x[order], y[order], np.full(len(x), np.nan), magnitude[order], np.zeros(3))


def scaled(camera, factor):
    return camera._replace(fx_px=camera.fx_px * factor, fy_px=camera.fy_px * factor)


def first_camera(*asked):
    return next(find_cameras(*asked), None)


@pytest.mark.parametrize("told", [0.91, 0.98, 1.0, 1.03, 1.09])
@pytest.mark.parametrize("flux", [True, False])
def test_a_focal_length_off_by_up_to_a_tenth_is_found(told, flux, skies_of):
    found = first_camera([frame(TRUE, 1, flux)], scaled(TRUE, told), 1.11, skies_of, MATCHING)
    assert found.camera.fx_px == pytest.approx(TRUE.fx_px, rel=2e-3)
    assert found.camera.fy_px > 0
    assert found.n_stars >= 6


def test_a_mirrored_image_is_found_and_its_sky_is_not_mirrored(skies_of):
    shown = frame(mirrored(TRUE), 2)
    found = first_camera([shown], scaled(TRUE, 1.04), 1.11, skies_of, MATCHING)
    assert found.camera.fy_px == pytest.approx(-TRUE.fy_px, rel=2e-3)
    assert found.camera.p1 == -TRUE.p1
    # The same directions as in the image with rows that count down.
    u = unproject(mirrored(TRUE), shown.x_px, shown.y_px)
    straight = unproject(TRUE, *project(TRUE, u))
    np.testing.assert_allclose(u, straight, atol=1e-9)


def test_a_frame_beyond_the_reach_and_a_starless_one_show_no_camera(skies_of):
    rng = np.random.default_rng(3)
    noise = ImageFrame(
        rng.uniform(0, 1023, 25), rng.uniform(0, 1023, 25), np.full(25, np.nan),
        np.sort(rng.uniform(3, 6, 25)), np.zeros(3),
    )  # fmt: skip
    far = scaled(TRUE, 1.25)
    assert first_camera([frame(TRUE, 4), noise], far, 1.05, skies_of, MATCHING) is None
    assert first_camera([frame(TRUE, 4)], far, 1.5, skies_of, MATCHING) is not None


def test_few_and_invalid_centroids_show_no_camera(skies_of):
    few = ImageFrame(*(column[:5] for column in frame(TRUE, 5)[:4]), np.zeros(3))
    none = ImageFrame(*[np.empty(0)] * 4, np.zeros(3))
    nan = ImageFrame(*[np.full(20, np.nan)] * 4, np.zeros(3))
    assert first_camera([few, none, nan], TRUE, 1.02, skies_of, MATCHING) is None
    assert first_camera([], TRUE, 1.02, skies_of, MATCHING) is None


def test_the_second_frame_is_searched_where_the_first_shows_nothing(skies_of):
    none = ImageFrame(*[np.empty(0)] * 4, np.zeros(3))
    found = first_camera([none, frame(TRUE, 6)], TRUE, 1.02, skies_of, MATCHING)
    assert found.frame == 1


def test_no_further_frame_is_searched_beyond_the_budget(skies_of):
    rng = np.random.default_rng(8)
    noise = frame(TRUE, 8)._replace(x_px=rng.uniform(0, 1023, len(frame(TRUE, 8).x_px)))
    asked = [noise, frame(TRUE, 6)], TRUE, 1.02, skies_of, MATCHING
    assert first_camera(*asked, 0.0) is None
    assert first_camera(*asked).frame == 1


def test_a_frame_with_errors_far_too_large_ends_within_the_limit(skies_of, monkeypatch):
    costs = []
    search = camera_search.search_frame

    def counted(*arguments):
        found = search(*arguments)
        costs.append(found.cost_s)
        return found

    monkeypatch.setattr(camera_search, "search_frame", counted)
    vague = frame(TRUE, 7)
    vague = vague._replace(sigma_px=np.full(len(vague.x_px), 50.0))
    assert first_camera([vague], TRUE, 1.11, skies_of, MATCHING, 0.0) is None
    assert sum(costs) < camera_search.FIRST_FRAME_S + 2 * camera_search.TRIAL_TIME_LIMIT_S


def test_another_frame_agrees_with_the_true_camera_alone(skies_of):
    assert agreeing_camera(frame(TRUE, 7), TRUE, skies_of, MATCHING)
    assert agreeing_camera(frame(TRUE, 7), scaled(TRUE, 1.2), skies_of, MATCHING) is None
    assert agreeing_camera(frame(TRUE, 7), mirrored(TRUE), skies_of, MATCHING) is None


@pytest.mark.parametrize("k1", [-1.0, -0.6, 0.7, 1.0])
@pytest.mark.parametrize("flux", [True, False])
def test_strong_distortion_that_is_not_told_is_found(k1, flux, skies_of):
    """In a field of 27 degrees, corners are off by 50 to 80 px."""
    told = scaled(Camera(1024, 1024, 2133.0, 2133.0, 511.5, 511.5), 1.02)
    true = scaled(told, 1 / 1.02)._replace(k1=k1, cx_px=509.0)
    for seed, side in ((8, true), (9, mirrored(true))):
        shown = frame(side, seed, flux, limit=4.9)
        found = first_camera([shown], told, 1.11, skies_of, MATCHING)
        assert found.camera.k1 == pytest.approx(k1, abs=0.06)
        assert found.camera.fy_px == pytest.approx(side.fy_px, rel=3e-3)
        assert found.n_stars > 0.6 * len(shown.x_px)


def test_each_frame_with_stars_shows_a_camera(skies_of):
    shown = [frame(TRUE, seed) for seed in (6, 7, 10)]
    found = list(find_cameras(shown, TRUE, 1.02, skies_of, MATCHING))
    assert [camera.frame for camera in found] == [0, 1, 2]


def test_a_camera_must_show_more_stars_than_the_told_one(skies_of):
    shown = frame(TRUE, 10)
    n_stars = first_camera([shown], TRUE, 1.02, skies_of, MATCHING).n_stars
    few, most = (shown._replace(n_stars=n) for n in (n_stars // 2, n_stars))
    assert first_camera([few], TRUE, 1.02, skies_of, MATCHING) is not None
    assert first_camera([most], TRUE, 1.02, skies_of, MATCHING) is None

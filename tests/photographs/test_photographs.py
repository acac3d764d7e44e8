"""Photographs of the sky, not simulated: the lens is known by its name alone."""

import csv
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.bridge import array
from epipole.tasks.algorithms.geometry.camera import Camera, pixel_angle, unproject
from epipole.tasks.algorithms.star_identification.camera_search import ImageFrame, find_cameras
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids
from epipole.tasks.algorithms.star_identification.frame import MatchSettings, field_of_view
from epipole.tasks.algorithms.star_identification.sensor import identify_sensor
from epipole.tasks.algorithms.star_identification.sequence import no_priors
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue

WIDTH, HEIGHT = 5184, 3456
F_PX = 50.0 / 22.3 * WIDTH  # a 50 mm lens before 22.3 mm of silicon, by name
TOLD = Camera(WIDTH, HEIGHT, F_PX, F_PX, (WIDTH - 1) / 2, (HEIGHT - 1) / 2)
HOW = MatchSettings(3.7, -np.log(1e-5), 0.5, np.nan)
DAY = 15_156  # 2011-07-01: the year is a guess
EXCHANGED = {66189: 66198}
PHOTOGRAPHS = ("great_bear", "cassiopeia")


@pytest.fixture(scope="module")
def skies_of():
    catalogue = Catalogue(read_hipparcos())
    return lambda pixel_rad: CachedSkies(catalogue, DAY, pixel_rad, 2.0)


def measured(name):
    """Return x, y [px] and Hipparcos numbers."""
    with (Path(__file__).parent / f"{name}.csv").open() as file:
        rows = list(csv.DictReader(file))
    x, y = (np.array([float(row[column]) for row in rows]) for column in ("x_px", "y_px"))
    listed = [int(row["star_id"]) for row in rows]
    return x, y, np.array([EXCHANGED.get(number, number) for number in listed])


def fitted_focal_px(x_px, y_px, listed):
    """Return the focal length with which SciPy turns the listed stars best onto their places."""
    stars = read_hipparcos()
    row = {number: k for k, number in enumerate(array(stars, "star_id").tolist())}
    at = [row[number] for number in listed.tolist()]
    ra, dec = (np.radians(array(stars, name)[at]) for name in ("ra_deg", "dec_deg"))
    u = np.column_stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])

    def misfit(f_px):
        camera = TOLD._replace(fx_px=f_px, fy_px=f_px)
        return Rotation.align_vectors(unproject(camera, x_px, y_px), u)[1]

    return minimize_scalar(misfit, bounds=(0.9 * F_PX, 1.1 * F_PX)).x


def camera_of(x_px, y_px, skies_of):
    unknown = np.full(len(x_px), np.nan)
    shown = ImageFrame(x_px, y_px, unknown, unknown, np.zeros(3))
    return next(find_cameras([shown], TOLD, 1.11, skies_of, HOW)).camera


def numbers(x_px, y_px, camera, skies_of):
    """Return the Hipparcos number of each place, 0 where none was found."""
    u, unknown = unproject(camera, x_px, y_px), np.full(len(x_px), np.nan)
    raw = RawCentroids(
        np.array([0, len(u)]), u, pixel_angle(camera, u), unknown, unknown, np.zeros((1, 3)),
        [field_of_view(camera)], np.zeros(1, np.int64),
    )  # fmt: skip
    found = identify_sensor(np.zeros(1), raw, no_priors(1), skies_of(camera.pixel_rad), None, HOW)
    star = found.solutions.star
    return np.where(star >= 0, found.sky.catalogue.star_id[star], 0)


@pytest.mark.parametrize("name", PHOTOGRAPHS)
@pytest.mark.parametrize("upside_down", [False, True])
def test_the_stars_are_those_that_the_author_found(name, upside_down, skies_of):
    x, y, listed = measured(name)
    shown = HEIGHT - 1 - y if upside_down else y
    camera = camera_of(x, shown, skies_of)
    assert (camera.fy_px < 0) == upside_down
    assert camera.fx_px == pytest.approx(fitted_focal_px(x, y, listed), rel=3e-3)
    found = numbers(x, shown, camera, skies_of)
    assert (found[found > 0] == listed[found > 0]).all()
    assert (found > 0).mean() > 0.95


@pytest.mark.parametrize("name", PHOTOGRAPHS)
def test_the_stars_are_found_among_hundreds_of_false_points(name, skies_of):
    x, y, listed = measured(name)
    camera, rng = camera_of(x, y, skies_of), np.random.default_rng(0)
    mixed = rng.permutation(len(x) + 400)
    all_x = np.append(x, rng.uniform(0, WIDTH, 400))[mixed]
    all_y = np.append(y, rng.uniform(0, HEIGHT, 400))[mixed]
    found = numbers(all_x, all_y, camera, skies_of)
    true = np.append(listed, np.zeros(400, np.int64))[mixed]
    assert (found[true > 0] == true[true > 0]).mean() > 0.9
    assert ((found > 0) & (true == 0)).sum() < 20

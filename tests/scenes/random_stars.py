"""Random skies and frames for the tests of star identification."""

from functools import cache

import numpy as np

from epipole.tasks.algorithms.geometry.camera import Camera, inside, pixel_angle, project, unproject
from epipole.tasks.algorithms.geometry.directions import canonical, matrix_from_quaternion
from epipole.tasks.algorithms.star_catalogue import NavigationCatalogue, limit_for_density
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids, SensorCentroids
from epipole.tasks.algorithms.star_identification.frame import (
    FieldOfView,
    FrameCentroids,
    MatchSettings,
    aberrate_all,
)
from epipole.tasks.algorithms.star_identification.star_grid import (
    pattern_pairs,
    pattern_size,
    sky_grid,
    sky_to_limit,
)

CAMERA = Camera(1024, 1024, 3660.0, 3660.0, 511.5, 511.5)  # 16 degrees
BETA = np.array([0.6e-4, -0.7e-4, 0.3e-4])  # aberration as of the Earth's motion
MATCHING = MatchSettings(3.7, np.log(1e6), 0.5, np.nan)


def random_catalogue(n=6000, seed=0):
    """Return n stars all over the sky, brightest first; fainter ones are more frequent."""
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(n, 3))
    magnitude = np.sort(6.2 + np.log10(rng.uniform(1e-4, 1, n)) / 0.5)
    return NavigationCatalogue(
        np.arange(1, n + 1), u / np.linalg.norm(u, axis=1, keepdims=True), magnitude
    )


def random_attitude(seed):
    """Return a (3, 3) rotation; all are equally likely."""
    return matrix_from_quaternion(canonical(np.random.default_rng(seed).normal(size=4)))


def optics(camera=CAMERA):
    """Return the field of a camera without distortion."""
    x = np.array([-0.5, camera.width - 0.5]) - camera.cx_px
    y = np.array([-0.5, camera.height - 0.5]) - camera.cy_px
    box = np.concatenate([x / camera.fx_px, y / camera.fy_px])
    return FieldOfView(camera.half_diagonal_rad, box, camera.pixel_rad)


def frame(catalogue, R, seed, sigma_px=0.3, n_false=0, missing=0.0, flux=True, camera=CAMERA):
    """Return the frame of a camera with this attitude, brightest first, and the true star of each
    centroid (row of the catalogue, -1 where there is none)."""
    rng = np.random.default_rng(seed)
    x, y = project(camera, aberrate_all(catalogue.u_icrs, BETA) @ R.T)
    row = np.flatnonzero(inside(camera, x, y))
    row = row[rng.uniform(size=len(row)) >= missing]
    x = np.concatenate([x[row], rng.uniform(0, camera.width - 1, n_false)])
    y = np.concatenate([y[row], rng.uniform(0, camera.height - 1, n_false)])
    x, y = x + rng.normal(0, sigma_px, len(x)), y + rng.normal(0, sigma_px, len(y))
    mag = np.concatenate([catalogue.magnitude[row], rng.uniform(2.5, 6, n_false)])
    mag += rng.normal(0, 0.2, len(mag)) - 20
    row = np.concatenate([row, np.full(n_false, -1)])
    order = np.argsort(mag)
    u = unproject(camera, x[order], y[order])
    mag = mag[order] if flux else np.full(len(x), np.nan)
    sigma_rad = sigma_px * pixel_angle(camera, u)
    return FrameCentroids(u, sigma_rad, mag, BETA, optics(camera)), row[order]


def join(frames):
    """Return frames in flat arrays."""
    optics_of = np.zeros(len(frames), np.int64)
    first = np.concatenate([[0], np.cumsum([len(f.u) for f in frames])]).astype(np.int64)
    return SensorCentroids(
        first, np.concatenate([f.u for f in frames]),
        np.concatenate([f.sigma_rad for f in frames]),
        np.concatenate([f.instrumental_mag for f in frames]),
        np.array([f.beta for f in frames]), [frames[0].optics], optics_of,
    )  # fmt: skip


def join_centroids(frames, sigma_px, pixel_rad):
    """Return frames in flat arrays, with these (n,) errors and pixel sizes of their centroids."""
    flat = join(frames)
    return RawCentroids(
        flat.first, flat.u, np.concatenate(pixel_rad), np.concatenate(sigma_px),
        flat.instrumental_mag, flat.beta, flat.optics, flat.optics_of,
    )  # fmt: skip


def angle_between(R, S):
    """Return the angle of the rotation between two attitudes [rad]."""
    return 2 * np.arcsin(np.linalg.norm(R - S) / np.sqrt(8))


LARGE_CATALOGUE = random_catalogue(15_000)
SEEN = sky_to_limit(LARGE_CATALOGUE, 5.75).catalogue


class Skies:
    """Skies of the large catalogue."""

    def limit_for(self, stars_per_sr):
        return limit_for_density(LARGE_CATALOGUE.magnitude, stars_per_sr)

    @cache  # noqa: B019 - lives as long as the tests
    def sky(self, limit):
        return sky_to_limit(LARGE_CATALOGUE, limit)

    @cache  # noqa: B019
    def grid(self, limit, radius_rad):
        return sky_grid(self.sky(limit), radius_rad)

    def pairs(self, limit, optics):
        n = pattern_size(self.sky(limit), optics.solid_angle_sr)
        return _pairs(n, 2 * optics.half_diagonal_rad)


@cache
def _pairs(n, diagonal_rad):
    return pattern_pairs(LARGE_CATALOGUE.u_icrs[:n], diagonal_rad)


SKIES = Skies()

"""Frames of star sensors with truth: read from a file, or made from Hipparcos."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from epipole.io.catalogues.hipparcos import HIPPARCOS_EPOCH, read_hipparcos
from epipole.schemas.arrays import Array, Integers
from epipole.schemas.bridge import array
from epipole.tasks.algorithms.geometry.camera import Camera, inside, project
from epipole.tasks.algorithms.geometry.directions import canonical, matrix_from_quaternion
from epipole.tasks.algorithms.star_catalogue import (
    NavigationCatalogue,
    navigation_catalogue,
    star_directions,
)

EPOCH = 2024.0
MERGED_PX = 2.0
SCATTER_MAG = 0.2
SIGMAS_PX, FALSE, MISSING = (0.0, 0.5, 1.0, 2.0), (0, 3, 10), (0.0, 0.2, 0.4)
CELLS = [(s, f, m) for s in SIGMAS_PX for f in FALSE for m in MISSING]


class Kind(NamedTuple):
    """A camera: square field [deg], image [px], faintest star that it detects [V]."""

    name: str
    field_deg: float
    width_px: int
    magnitude_limit: float

    @property
    def camera(self) -> Camera:
        f = self.width_px / 2 / np.tan(np.radians(self.field_deg) / 2)
        middle = self.width_px / 2 - 0.5
        return Camera(self.width_px, self.width_px, f, f, middle, middle)


KINDS = {
    "a": Kind("a", 20.3, 1024, 5.5),
    "b": Kind("b", 12.0, 512, 6.0),
    "c": Kind("c", 8.0, 1024, 7.0),
}
FILES = {"a": "a_fov20.npz", "b": "b_fov12.npz", "c": "c_fov08.npz"}


class Frames(NamedTuple):
    """Frames of one camera, pixels in this project's convention, brightest centroid first.

    stars : to the camera's limit + 1, close pairs not merged
    offset : (F + 1,); frame k is rows offset[k]:offset[k + 1] of x_px, y_px, mag, star_id
    star_id : true number, -1 false
    R_sensor_from_icrs : (F, 3, 3)
    cell : (F,) row of CELLS
    """

    kind: Kind
    stars: NavigationCatalogue
    offset: Integers
    x_px: Array
    y_px: Array
    mag: Array
    star_id: Integers
    R_sensor_from_icrs: Array
    cell: Integers


def read_frames(folder: Path, name: str) -> Frames:
    """Return the frames of a shared sample file (its README has the layout)."""
    with np.load(folder / FILES[name]) as data:
        d = dict(data)
    stars = NavigationCatalogue(
        d["cat_hip"].astype(np.int64), d["cat_vec"], d["cat_mag"].astype(float)
    )
    # There the middle of the top-left pixel is (0.5, 0.5).
    return Frames(
        KINDS[name], stars, d["offset"], d["x"] - 0.5, d["y"] - 0.5, d["mag"].astype(float),
        d["true_id"].astype(np.int64), d["rot"], d["cell"].astype(np.int64),
    )  # fmt: skip


def hipparcos_at_epoch(limit: float) -> NavigationCatalogue:
    """Return Hipparcos to a magnitude at EPOCH, brightest first, without parallax."""
    table = read_hipparcos()
    places = [np.radians(array(table, name)) for name in ("ra_deg", "dec_deg")]
    motions = [array(table, name) for name in ("parallax_mas", "pm_ra_mas_yr", "pm_dec_mas_yr")]
    u = star_directions(*places, *motions, EPOCH - HIPPARCOS_EPOCH, np.zeros(3))
    kept = array(table, "magnitude") <= limit
    return navigation_catalogue(
        array(table, "star_id")[kept], u[kept], array(table, "magnitude")[kept], 0.0
    )


def seen_stars(stars: NavigationCatalogue, kind: Kind) -> NavigationCatalogue:
    """Return the stars that the camera resolves: stars closer than MERGED_PX are merged."""
    merged = navigation_catalogue(*stars, MERGED_PX * kind.camera.pixel_rad)
    n = int(np.searchsorted(merged.magnitude, kind.magnitude_limit, side="right"))
    return NavigationCatalogue(*[column[:n] for column in merged])


def make_frames(name: str, cells: Integers, seed: int) -> Frames:
    """Return one frame of the cell for each entry of `cells`, all attitudes equally likely."""
    rng = np.random.default_rng(seed)
    kind = KINDS[name]
    stars = hipparcos_at_epoch(kind.magnitude_limit + 1.0)
    seen = seen_stars(stars, kind)
    R = matrix_from_quaternion(canonical(rng.normal(size=(len(cells), 4))))
    shots = [expose(kind, seen, R[k], *CELLS[c], rng) for k, c in enumerate(cells)]
    offset = np.concatenate([[0], np.cumsum([len(s[0]) for s in shots])])
    x, y, mag, star_id = (np.concatenate(column) for column in zip(*shots, strict=True))
    return Frames(kind, stars, offset, x, y, mag, star_id, R, np.asarray(cells))


def expose(
    kind: Kind,
    seen: NavigationCatalogue,
    R: Array,
    sigma_px: float,
    n_false: int,
    missing: float,
    rng: np.random.Generator,
) -> tuple[Array, Array, Array, Integers]:
    """Return x, y [px], magnitude and true number (-1 false) of the centroids of one frame."""
    near = np.flatnonzero(seen.u_icrs @ R[2] > np.cos(1.05 * kind.camera.half_diagonal_rad))
    x, y = project(kind.camera, seen.u_icrs[near] @ R.T)
    shown = inside(kind.camera, x, y) & (rng.uniform(size=len(near)) >= missing)
    x, y, row = x[shown], y[shown], near[shown]
    x, y = x + rng.normal(0, 1, len(x)) * sigma_px, y + rng.normal(0, 1, len(y)) * sigma_px
    still = inside(kind.camera, x, y)
    x, y, row = x[still], y[still], row[still]
    mag = seen.magnitude[row] + rng.normal(0, SCATTER_MAG, len(row))
    edge = kind.width_px - 0.5
    x = np.concatenate([x, rng.uniform(-0.5, edge, n_false)])
    y = np.concatenate([y, rng.uniform(-0.5, edge, n_false)])
    limit = kind.magnitude_limit
    mag = np.concatenate([mag, rng.uniform(limit - 3.5, limit, n_false)])
    star_id = np.concatenate([seen.star_id[row], np.full(n_false, -1)])
    order = np.argsort(mag, kind="stable")
    return x[order], y[order], mag[order], star_id[order]

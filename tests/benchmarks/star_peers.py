"""Public star identification tools behind one call: pixels in, attitude out.

Each is given what it asks for: the field of view, the image size, centroids brightest
first, and a catalogue of its own kind. Where a tool is not installed it is left out.
"""

import logging
import math
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
from star_frames import EPOCH, Frames

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.arrays import Array
from epipole.schemas.bridge import array

# x, y [px], magnitude and error [px] of a frame's centroids -> sensor from ICRS, or None.
Solver = Callable[[Array, Array, Array, float], Array | None]

# As our own time limit; their defaults are ten times as long.
TIMEOUT_MS = 500


def tetra3rs(frames: Frames, cache: Path, error_told: bool) -> Solver | None:
    """Return tetra3rs' solver; told the error of centroids, or with its defaults."""
    try:
        import tetra3rs as tool
    except ImportError:
        return None
    kind = frames.kind
    stored = cache / f"tetra3rs_{tool.__version__}_{kind.field_deg:g}.bin"
    if not stored.exists():
        made = tool.SolverDatabase.generate_from_gaia(
            max_fov_deg=kind.field_deg, epoch_proper_motion_year=EPOCH
        )
        made.save_to_file(str(stored))
    database = tool.SolverDatabase.load_from_file(str(stored))
    middle = kind.width_px / 2 - 0.5

    def solve(x_px: Array, y_px: Array, mag: Array, sigma_px: float) -> Array | None:
        spots = np.column_stack([x_px - middle, y_px - middle, 10.0 ** (-0.4 * (mag - 10.0))])
        told = {}
        if error_told:
            # Edge ratios err by about the error over the longest edge, half a field.
            told["match_max_error"] = max(0.001, 4.0 * sigma_px / (0.5 * kind.width_px))
            told["match_radius"] = max(0.002, 3.0 * sigma_px / kind.width_px)
        found = database.solve_from_centroids(
            spots,
            fov_estimate_deg=kind.field_deg,
            fov_max_error_deg=0.02 * kind.field_deg,
            image_shape=(kind.width_px, kind.width_px),
            solve_timeout_ms=TIMEOUT_MS,
            **told,
        )
        if not found:
            return None
        R = np.asarray(found.rotation_matrix_icrs_to_camera)
        return np.diag([-1.0, 1.0, 1.0]) @ R if found.parity_flip else R

    return solve


def cedar_solve(frames: Frames, cache: Path) -> Solver | None:
    """Return cedar-solve's solver, on a database made from Hipparcos for the camera's field."""
    try:
        from tetra3 import Tetra3
    except ImportError:
        return None
    np.math = math  # type: ignore[attr-defined]  # 0.5.1 is written for NumPy 1
    logging.getLogger("tetra3.Tetra3").setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", module="tetra3")
    kind = frames.kind
    stored = cache / f"cedar_solve_{kind.field_deg:g}.npz"
    if not stored.exists():
        maker = Tetra3(load_database=None)
        maker.generate_database(
            max_fov=kind.field_deg,
            save_as=stored,
            star_catalog=hip_main(cache),
            epoch_proper_motion=EPOCH,
        )
    solver = Tetra3(load_database=stored)
    size = (kind.width_px, kind.width_px)

    def solve(x_px: Array, y_px: Array, mag: Array, sigma_px: float) -> Array | None:
        spots = np.column_stack([y_px, x_px]) + 0.5
        found = solver.solve_from_centroids(
            spots,
            size,
            fov_estimate=kind.field_deg,
            fov_max_error=0.02 * kind.field_deg,
            solve_timeout=TIMEOUT_MS,
            match_max_error=max(0.002, 4.0 * sigma_px / (0.5 * kind.width_px)),
            match_radius=max(0.002, 3.0 * sigma_px / kind.width_px),
        )
        if found["RA"] is None:
            return None
        return _attitude(*np.radians([found["RA"], found["Dec"], found["Roll"]]))

    return solve


def _attitude(ra: float, dec: float, roll: float) -> Array:
    """Return the attitude of a boresight where celestial north is `roll` counter-clockwise
    from image up (that is, towards -x for a roll of 90 degrees)."""
    z = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.cross(z, east)
    # Seen from inside the sphere east is counter-clockwise of north, image left of up.
    up = np.cos(roll) * north - np.sin(roll) * east
    return np.stack([np.cross(-up, z), -up, z])


def hip_main(folder: Path) -> Path:
    """Return a file laid out as Hipparcos' hip_main.dat, as far as cedar-solve reads it."""
    path = folder / "hip_main.dat"
    table = read_hipparcos()
    names = ("star_id", "magnitude", "ra_deg", "dec_deg", "pm_ra_mas_yr", "pm_dec_mas_yr")
    number, mag, ra, dec, pm_ra, pm_dec = (array(table, name) for name in names)
    blank = [" "] * 14
    with path.open("w") as file:
        for k in range(len(number)):
            row = blank.copy()
            row[1], row[5] = str(number[k]), f"{mag[k]:.2f}"
            row[8], row[9] = f"{ra[k]:.8f}", f"{dec[k]:.8f}"
            row[12], row[13] = f"{pm_ra[k]:.2f}", f"{pm_dec[k]:.2f}"
            file.write("|".join(row) + "\n")
    return path

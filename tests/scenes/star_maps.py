"""Simulated maps of the sky for the tests of the published star identification."""

import csv
from pathlib import Path

import numpy as np
from benchmarks.star_frames import Kind, expose, hipparcos_at_epoch, seen_stars

from epipole.tasks.algorithms.geometry.camera import pixel_angle, project, unproject
from epipole.tasks.algorithms.geometry.directions import unit_from_radec

SEEDS = Path(__file__).parents[3] / "shared" / "data" / "seed_star_maps.csv"
WIDE = Kind("orbit", 20.3, 1024, 5.5)
INCLINATION = np.radians(51.6)
# Two of the eight maps have three stars with a large error.
NOISY = {3: (1942, 1941, 1900), 6: (1477, 1603, 1488)}


def looking(boresight, roll):
    """Return the attitude (sensor from ICRS) with this boresight, turned by roll [rad]."""
    z = boresight / np.linalg.norm(boresight)
    x = np.cross([0.0, 0.0, 1.0] if abs(z[2]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    c, s = np.cos(roll), np.sin(roll)
    return np.stack([c * x + s * y, -s * x + c * y, z])


def orbit_maps(n, seed=0):
    """Return the catalogue, and n maps evenly along one orbit with 0.5 px error: (u, sigma
    [rad], true star numbers, attitude) each."""
    rng = np.random.default_rng(seed)
    seen = seen_stars(hipparcos_at_epoch(WIDE.magnitude_limit + 1), WIDE)
    maps = []
    for angle in np.linspace(0, 2 * np.pi, n, endpoint=False):
        along = np.array([np.cos(angle), np.sin(angle), 0.0])
        c, s = np.cos(INCLINATION), np.sin(INCLINATION)
        R = looking(np.array([along[0], c * along[1], s * along[1]]), 0.7)
        x, y, _, star_id = expose(WIDE, seen, R, 0.5, 0, 0.0, rng)
        u = unproject(WIDE.camera, x, y)
        maps.append((u, 0.5 * pixel_angle(WIDE.camera, u), star_id, R))
    return seen, maps


def contest_maps(seed=0, sigma_px=0.3, large_px=8.0):
    """Return the eight maps by number: (kind, u, stated sigma [rad], true numbers, attitude).

    The stars are those of the source. Attitudes, places and sizes of errors are chosen here: the
    source only states that three stars of maps 3 and 6 have a large error.
    """
    rng = np.random.default_rng(seed)
    with SEEDS.open() as file:
        rows = list(csv.DictReader(file))
    maps = {}
    for number in range(1, 9):
        shown = [r for r in rows if str(number) in r["maps"].split()]
        kind = Kind(f"map {number}", *((12.0, 512) if number < 7 else (20.0, 1024)), 6.0)
        u_icrs = unit_from_radec(
            *(np.radians([float(r[k]) for r in shown]) for k in ("ra_j2000_deg", "dec_j2000_deg"))
        )
        R = _holding(u_icrs, kind)
        x, y = project(kind.camera, u_icrs @ R.T)
        x, y = x + rng.normal(0, sigma_px, len(x)), y + rng.normal(0, sigma_px, len(y))
        for k, row in enumerate(shown):
            if int(row["table_index"]) in NOISY.get(number, ()):
                turn = rng.uniform(0, 2 * np.pi)
                x[k], y[k] = x[k] + large_px * np.cos(turn), y[k] + large_px * np.sin(turn)
        order = np.argsort([float(r["v_mag"]) for r in shown], kind="stable")
        u = unproject(kind.camera, x[order], y[order])
        star_id = np.array([int(r["hip"]) for r in shown])[order]
        maps[number] = (kind, u, sigma_px * pixel_angle(kind.camera, u), star_id, R)
    return maps


def _holding(u_icrs, kind):
    """Return an attitude that shows all these stars, as far inside the image as possible."""
    middle = u_icrs.mean(axis=0)
    best, best_margin = None, -np.inf
    for roll in np.radians(np.arange(0, 90, 3)):
        R = looking(middle, roll)
        for _ in range(20):  # centre the box that holds them
            x, y = project(kind.camera, u_icrs @ R.T)
            off_x = (x.min() + x.max()) / 2 - kind.camera.cx_px
            off_y = (y.min() + y.max()) / 2 - kind.camera.cy_px
            f = kind.camera.fx_px
            R = looking(R[2] + (off_x * R[0] + off_y * R[1]) / f, roll)
        x, y = project(kind.camera, u_icrs @ R.T)
        margin = kind.width_px - max(np.ptp(x), np.ptp(y))
        if margin > best_margin:
            best, best_margin = R, margin
    return best

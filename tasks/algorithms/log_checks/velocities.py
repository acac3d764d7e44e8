"""Velocities: whether they are those of the path of positions, and how else they may be meant."""

from collections.abc import Sequence
from itertools import permutations, product

import numpy as np

from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.constants import GM_KM3_S2
from epipole.tasks.algorithms.log_checks.findings import (
    SOUND,
    UNKNOWN,
    VELOCITY,
    WRONG,
    Finding,
)
from epipole.tasks.algorithms.log_checks.free_fall import ReadArc, fall
from epipole.tasks.algorithms.log_checks.readings import EARTH_FIXED

FAR = 3.0  # times what is allowed: beyond doubt
SIGMAS = 5.0
MODEL_SHARE = 0.003  # of the orbital speed, allowed for what the path leaves out
ZERO_KM_S = 1e-9
CLEARLY = 0.1  # what another meaning leaves of the difference
LARGE_SHARE = 0.1  # of the speed: another velocity, and not a poor one
# Of the orbital speed: more noise is not allowed for. Else velocities at random were sound.
MAX_NOISE_SHARE = LARGE_SHARE / SIGMAS


def check_velocities(arcs: Sequence[ReadArc]) -> Finding:
    """Return whether velocities are those of the path, of arcs as the positions are meant."""
    path, stated, r, allowed = _compared(arcs)
    if not len(stated):
        return Finding(VELOCITY, UNKNOWN, cause="no_velocities")
    off = _median_length(stated - path)
    speed = _median_length(path)
    found = Finding(VELOCITY, SOUND, off, allowed / SIGMAS, 0.0, "km/s", "", {"speed_km_s": speed})
    if (np.abs(stated) < ZERO_KM_S).all() and speed > FAR * allowed:
        return found._replace(verdict=WRONG, cause="velocities_zero")
    if off <= allowed:
        return found
    for cause, meant in _meanings(path, r):
        rest = _median_length(stated - meant)
        if rest <= allowed * max(_median_length(meant) / speed, 1.0) and rest <= CLEARLY * off:
            return found._replace(verdict=WRONG, cause=cause)
    large = off > FAR * allowed and off > LARGE_SHARE * max(speed, _orbital_speed(r))
    return found._replace(
        verdict=WRONG if large else UNKNOWN,
        cause="velocities_disagree" if large else "velocities_uncertain",
    )


def _compared(arcs: Sequence[ReadArc]) -> tuple[Array, Array, Array, float]:
    """Return velocities of the path, stated ones, positions [km], and the allowed difference."""
    path, stated, r, allowed = [], [], [], []
    for arc in arcs:
        known = np.isfinite(arc.v_km_s[:, 0])
        if not known.any():
            continue
        found = fall(arc)
        path.append(found.v_km_s[known])
        stated.append(arc.v_km_s[known])
        r.append(arc.r_km[known])
        speed = _orbital_speed(r[-1])
        sigma = found.v_sigma_km_s + min(_noise(stated[-1] - path[-1]), MAX_NOISE_SHARE * speed)
        allowed.append(SIGMAS * sigma + MODEL_SHARE * speed)
    if not path:
        none = np.zeros((0, 3))
        return none, none, none, np.nan
    return (
        np.concatenate(path), np.concatenate(stated), np.concatenate(r), float(np.median(allowed))
    )  # fmt: skip


def _noise(off: Array) -> float:
    """Return the scatter [km/s] of differences (n, 3) that follow each other; 0 of less than three.

    Second differences: those of velocities that are wrong change steadily along the path. Scaled
    as the length of a step between two that are independent.
    """
    bends = np.diff(off, n=2, axis=0)
    return _median_length(bends) / np.sqrt(3.0) if len(bends) else 0.0


def _meanings(path: Array, r_km: Array) -> list[tuple[str, Array]]:
    """Return what velocities may be by mistake, with the mistake."""
    turning = np.cross(EARTH_FIXED, r_km)
    meanings = [
        ("velocities_negated", -path),
        ("velocities_in_m_s", 1000.0 * path),
        ("velocities_per_ms", path / 1000.0),
        ("velocities_inertial", path + turning),
        ("velocities_earth_fixed", path - turning),
    ]
    for axes in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            meanings.append(("velocity_axes", path[:, axes] * np.array(signs)))
    return meanings


def _orbital_speed(r_km: Array) -> float:
    """Return the speed of a circular orbit [km/s], which does not depend on the axes."""
    return float(np.sqrt(GM_KM3_S2 / np.median(np.linalg.norm(r_km, axis=1))))


def _median_length(vectors: Array) -> float:
    return float(np.median(np.linalg.norm(vectors, axis=1)))

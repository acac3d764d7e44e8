"""Ephemerides of all kinds, as a log has them: orbits, sampling, errors, frames."""

import erfa
import numpy as np

from epipole.tasks.algorithms.log_checks.states import LogStates
from epipole.tasks.algorithms.simulation.paths import state_at

EARTH_RATE_RAD_S = 7.2921150e-5
# a [km], e, largest inclination [deg]
ORBITS = {
    "low": (7000.0, 0.01, 100.0),
    "middle": (26_560.0, 0.02, 64.0),
    "geostationary": (42_164.2, 0.0003, 0.1),
    "eccentric": (26_600.0, 0.72, 63.4),
    "transfer": (24_400.0, 0.72, 28.0),
    "high": (110_000.0, 0.5, 60.0),
}
SECOND_NS = 1_000_000_000


def ephemeris(rng, kind, duration_s, step_s, noise_km, sigma_km, velocities=True, itrf=False):
    """Return the states of a random orbit, two-body, as LogStates."""
    a, e, i = ORBITS[kind]
    elements = np.array([
        a * rng.uniform(0.97, 1.1 if kind != "geostationary" else 0.9701), e,
        np.radians(rng.uniform(0, i)), *rng.uniform(0, 2 * np.pi, 3),
    ])  # fmt: skip
    if kind == "geostationary":
        elements[0] = a
    t = np.arange(0.0, duration_s + step_s / 2, step_s)
    r, v = state_at(elements, t)
    r = r + rng.normal(0, sigma_km, 3) + rng.normal(0, noise_km, r.shape)
    v = v + rng.normal(0, noise_km * 1e-2, v.shape)
    if itrf:
        r, v = earth_fixed(t, r, v)
    if not velocities:
        v = np.full_like(v, np.nan)
    time_ns = 1_554_091_200 * SECOND_NS + np.round(t * 1e9).astype(np.int64)
    return LogStates(time_ns, r, v, np.full(len(t), sigma_km), itrf)


def earth_fixed(t_s, r, v):
    """Return states in axes that turn with the Earth."""
    turn = np.stack([erfa.rz(0.3 + EARTH_RATE_RAD_S * t, np.eye(3)) for t in t_s])
    r, v = np.einsum("nij,nj->ni", turn, r), np.einsum("nij,nj->ni", turn, v)
    return r, v - np.cross([0, 0, EARTH_RATE_RAD_S], r)

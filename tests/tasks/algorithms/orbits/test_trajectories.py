"""Trajectories: against SciPy's integrator, SGP4, and differences of whole trajectories."""

import numpy as np
import pytest
from scenes.night_orbits import AROUND, GEO, LOW, NOON_NS
from scipy.integrate import solve_ivp
from sgp4.api import WGS72, Satrec

from epipole.tasks.algorithms.orbits.forces import accelerate
from epipole.tasks.algorithms.orbits.reference_frames import gcrf_from_teme, orientation_at
from epipole.tasks.algorithms.orbits.trajectories import (
    MAX_STEPS,
    integrate,
    interpolate_derivatives,
    interpolate_position,
    propagate_unknowns,
)

METRE = 1e-3
TRANSFER = np.array([6800.0, 100.0, 500.0, 0.1, 8.9, 4.0, 0.02, 0.0])  # up to 30,000 km


def reference(unknowns, to_s):
    """Return the state at another time, by SciPy."""

    def rates(t, y):
        work, out = np.zeros((4, 3)), np.empty(3)
        accelerate(t, y[:3].copy(), y[3:].copy(), unknowns[6:], AROUND, work, out)
        return np.concatenate([y[3:], out])

    found = solve_ivp(rates, (0, to_s), unknowns[:6], method="DOP853", rtol=1e-13, atol=1e-10)
    return found.y[:, -1]


@pytest.mark.parametrize("unknowns", [GEO, LOW, TRANSFER])
@pytest.mark.parametrize("to_s", [-600.0, 5400.0, 43_200.0])
def test_orbits_agree_with_scipy_at_nodes_and_between(unknowns, to_s):
    state = reference(unknowns, to_s)
    moved, _ = propagate_unknowns(unknowns, 0.0, to_s, AROUND)
    assert np.linalg.norm(moved[:3] - state[:3]) < METRE
    assert (moved[6:] == unknowns[6:]).all()
    path = integrate(unknowns, 0.0, min(to_s, 0.0) * 1.1, max(to_s, 0.0) * 1.1, AROUND)
    x = np.empty(3)
    interpolate_position(to_s, path, x)
    assert np.linalg.norm(x - state[:3]) < METRE


@pytest.mark.parametrize("unknowns", [GEO, LOW, LOW + 0.02 * np.eye(8)[7]])
def test_derivatives_are_those_of_whole_trajectories(unknowns):
    to_s = 6000.0
    _, transition = propagate_unknowns(unknowns, 0.0, to_s, AROUND)
    path = integrate(unknowns, 0.0, 0.0, to_s, AROUND)
    jacobian = np.empty((3, 8))
    interpolate_derivatives(to_s, path, jacobian)
    for k, step in enumerate([0.01] * 3 + [1e-5] * 3 + [1e-3] * 2):
        d = step * np.eye(8)[k]
        ends = [propagate_unknowns(unknowns + s * d, 0.0, to_s, AROUND)[0] for s in (1, -1)]
        slope = (ends[0] - ends[1]) / (2 * step)
        if np.abs(slope[:6]).max() > 0.0:
            # Sunlight begins within a step, where an orbit leaves the shadow.
            part = 2e-2 if k == 6 else 1e-3
            assert np.abs(transition[:6, k] - slope[:6]).max() < part * np.abs(slope[:6]).max()
            assert np.abs(jacobian[:, k] - slope[:3]).max() < part * np.abs(slope[:6]).max()


# Two-line elements of May 2026: a geostationary satellite and one in a low orbit.
SETS = {
    "geo": (
        "1 40874U 15041A   26150.00000000 -.00000290  00000+0  00000+0 0  9994",
        "2 40874   0.0500  90.0000 0002000 100.0000 200.0000  1.00270000 39000",
    ),
    "low": (
        "1 36508U 10013A   26150.00000000  .00000100  00000+0  30000-4 0  9991",
        "2 36508  92.0300 100.0000 0007000 200.0000 160.0000 14.52170000830000",
    ),
}


@pytest.mark.parametrize(("name", "hours", "off_km"), [("geo", 6.0, 2.0), ("low", 1.5, 1.0)])
def test_orbits_agree_with_sgp4_within_its_errors(name, hours, off_km):
    """SGP4 neglects J2 squared in a low orbit, and terms of half a month's Moon in a high one."""
    satellite = Satrec.twoline2rv(*SETS[name], WGS72)
    time_ns = NOON_NS + np.array([0, round(hours * 3.6e12)])
    days = time_ns / 86_400e9 + 2440587.5
    _, r_teme, v_teme = satellite.sgp4_array(np.floor(days), days - np.floor(days))
    zero = np.zeros(2)
    around = orientation_at(time_ns, np.array([60000.0, 62000.0]), zero, zero, zero)
    r, v = gcrf_from_teme(time_ns, r_teme, v_teme, around)
    R = AROUND.R_night_from_gcrf
    start = np.concatenate([R @ r[0], R @ v[0], [0.0, 0.0]])
    moved, _ = propagate_unknowns(start, 0.0, hours * 3600.0, AROUND)
    assert np.linalg.norm(R.T @ moved[:3] - r[1]) < off_km


def test_an_orbit_of_too_many_steps_is_refused():
    with pytest.raises(ValueError, match="steps; at most"):
        integrate(LOW, 0.0, 0.0, 1e3 * MAX_STEPS, AROUND)

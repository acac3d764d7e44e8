"""Initial orbit: near enough to the truth that the fit to all directions converges to it."""

import numpy as np
import pytest
from scenes.night_orbits import AROUND, GEO, LOW, trial

from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.orbit_linking.population import log_density
from epipole.tasks.algorithms.orbits.initial_orbit import GRAVITY_ALONE, initial_orbit
from epipole.tasks.algorithms.orbits.orbit_determination import determine_orbit
from epipole.tasks.algorithms.simulation.paths import state_at

TURNS = np.array([-30.0, -20.0, -10.0, 0.0])  # one sensor after the other


def one_after_the_other(seed, truth, apart_s):
    """Return directions of which no two sensors have any at one time."""
    times_s = np.concatenate([k * apart_s + TURNS for k in range(3)])
    seen = trial(seed, truth, times_s=times_s)
    turn = np.repeat(np.arange(len(times_s)) // len(TURNS), 3)
    rows = np.flatnonzero(seen.sensor == turn)
    return type(seen)(*(a[rows] for a in seen[:-1]), seen.prior)


@pytest.mark.parametrize(("truth", "apart_s"), [(LOW, 60.0), (LOW, 180.0), (GEO, 200.0)])
@pytest.mark.parametrize("seed", range(4))
def test_sensors_that_never_see_an_object_together_have_its_orbit(seed, truth, apart_s):
    directions = one_after_the_other(seed, truth, apart_s)
    state, at_s = initial_orbit(directions, AROUND, log_density)
    orbit = determine_orbit(directions, state, at_s, 0.0, GRAVITY_ALONE, AROUND)
    off = (orbit.unknowns - truth)[:6]
    assert off @ np.linalg.solve(orbit.cov[:6, :6], off) < 22.5  # 1 in 1,000 is above


def test_the_minutes_that_most_sensors_saw_are_taken():
    early, late = one_after_the_other(1, LOW, 60.0), trial(1, LOW, times_s=TURNS + 5000.0)
    late = type(late)(*(a[late.sensor == 0] for a in late[:-1]), late.prior)
    both = type(early)(
        *(np.concatenate([b, a]) for a, b in zip(late[:-1], early[:-1], strict=True)), early.prior
    )
    _, at_s = initial_orbit(both, AROUND, log_density)
    assert at_s == early.time_s[0]


def test_directions_of_no_orbit_have_none():
    directions = one_after_the_other(2, LOW, 60.0)
    down = -directions.r_km / np.linalg.norm(directions.r_km, axis=1, keepdims=True)
    inward = directions._replace(u=down, basis=tangent_basis(down))
    assert initial_orbit(inward, AROUND, log_density) is None
    one = type(directions)(*(a[:1] for a in directions[:-1]), directions.prior)
    assert initial_orbit(one, AROUND, log_density) is None


def seen_by_one_satellite(n, seconds):
    """Return n arcs of low objects above the horizon of a low satellite, and the true orbits."""
    found, seed = [], 0
    while len(found) < n:
        seed += 1
        truth = GEO.copy()
        angles = np.random.default_rng(seed).uniform(0, 2 * np.pi, 4)
        elements = np.array([6850.0 + 150.0 * angles[3], 0.001, angles[0] / 2, *angles[1:]])
        truth[:6] = np.concatenate(state_at(elements, np.array(0.0)))
        times_s = np.linspace(-seconds / 2, seconds / 2, 21)
        seen = trial(seed, truth, times_s=times_s, n_sensors=1)
        line = truth[:3] - seen.r_km[10]
        far_km = np.linalg.norm(line)
        lowest2 = seen.r_km[10] @ seen.r_km[10] - min(line @ seen.r_km[10] / far_km, 0.0) ** 2
        if lowest2 > 6478.0**2 and far_km < 4000.0:
            found.append((seen, truth))
    return found


@pytest.mark.parametrize("seconds", [20.0, 60.0])
def test_an_object_that_one_satellite_sees_is_not_taken_to_fly_beside_it(seconds):
    squares = []
    for seen, truth in seen_by_one_satellite(24, seconds):
        state, at_s = initial_orbit(seen, AROUND, log_density)
        orbit = determine_orbit(seen, state, at_s, 0.0, GRAVITY_ALONE, AROUND)
        off = (orbit.unknowns - truth)[:6]
        squares.append(off @ np.linalg.solve(orbit.cov[:6, :6], off))
    # So short an arc may have two orbits that are as likely.
    assert np.mean(np.array(squares) < 22.5) > 0.9

"""Population: its density has the right total, and the density of attributables is its integral."""

import numpy as np
from scenes.orbit_tracklets import orbit_tracklets

from epipole.tasks.algorithms.orbit_linking.population import (
    BAND_KM,
    COMPONENTS,
    MIN_HEIGHT_KM,
    N_OBJECTS,
    SIGMA,
    log_attributable_density,
    log_density,
    log_height_density,
    prior_of,
)

RADIUS, GM = 6378.137, 398600.4418


def density(x):
    """Return the density of objects at a state."""
    total, pulls = 0.0, np.empty(2)
    for component in range(COMPONENTS):
        log = prior_of(x, component, pulls)
        total += np.exp(log - pulls @ pulls / 2)
    return total


def test_the_density_of_many_states_is_that_of_each():
    rng = np.random.default_rng(4)
    states = np.hstack([rng.normal(size=(200, 3)) * 9000.0, rng.normal(size=(200, 3)) * 5.0])
    expected = [density(x) for x in states]
    np.testing.assert_allclose(np.exp(log_density(states)), expected, rtol=1e-9)
    assert 0 < np.sum(np.array(expected) == 0.0) < 100  # those in the ground


def test_heights_add_up_to_all_objects():
    r = (
        RADIUS
        + MIN_HEIGHT_KM
        + np.concatenate([np.arange(0.5, BAND_KM), np.arange(BAND_KM, 2e5, 50)])
    )
    width = np.concatenate([np.full(int(BAND_KM), 1.0), np.full(len(r) - int(BAND_KM), 50.0)])
    per_km3 = np.exp([log_height_density(each) for each in r])
    assert abs(np.sum(4 * np.pi * r**2 * per_km3 * width) / N_OBJECTS - 1) < 0.01
    assert log_height_density(RADIUS) == -np.inf


def test_velocities_at_a_position_add_up_to_one():
    r, pulls = RADIUS + 800.0, np.empty(2)
    circular, total, steps = np.sqrt(GM / r), 0.0, np.linspace(-5, 5, 101)
    for component in range(COMPONENTS):
        sigma = SIGMA[component]
        for level in 1.0 + sigma * steps[sigma * steps > -0.99]:
            for radial in sigma * steps:
                x = np.array([r, 0, 0, radial * circular, 0, level * circular])
                log = prior_of(x, component, pulls)
                ring = 2 * np.pi * level * circular  # of directions
                total += np.exp(log - pulls @ pulls / 2) * ring * (0.1 * sigma * circular) ** 2
    assert abs(total / np.exp(log_height_density(r)) - 1) < 0.01


def test_the_density_of_attributables_is_the_integral_over_range_and_its_rate():
    scene = orbit_tracklets(3, 2, 1, 10.0)
    seen = scene.tracklets
    found = log_attributable_density(seen.r_km, seen.v_km_s, seen.u, seen.w)
    step, width = np.log(6e3) / 300, 24.0 / 500
    for k in range(2):
        total, u = 0.0, seen.u[k]
        for range_km in 10.0 * np.exp((np.arange(300) + 0.5) * step):
            r = seen.r_km[k] + range_km * u
            across = seen.v_km_s[k] - seen.v_km_s[k] @ u * u + range_km * seen.w[k]
            if across @ across > 150:
                continue
            for rate in -12.0 + (np.arange(500) + 0.5) * width:
                v = across + rate * u
                if v @ v < 2 * GM / np.linalg.norm(r):
                    total += density(np.concatenate([r, v])) * range_km**5 * step * width
        assert abs(found[k] - np.log(total)) < 0.1

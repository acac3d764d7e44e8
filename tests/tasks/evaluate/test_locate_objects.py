"""Where true objects are."""

import dataclasses

import numpy as np
import pytest
from scenes.little_night import RINGS, SECOND_NS, T0_NS, little_truth, rows

from epipole.schemas.work_tables import TRUE_ORBITS
from epipole.tasks.algorithms.simulation.orbits import state_at
from epipole.tasks.evaluate.locate_objects import locate_objects

METRE, MM_S = 1e-3, 1e-6  # in km and km/s


def sampled(number, elements, t_s):
    r_km, v_km_s = state_at(np.array(elements), t_s)
    return [
        {"object": number, "t_ns": T0_NS + int(t * SECOND_NS)}
        | dict(zip(("x", "y", "z"), r, strict=True))
        | dict(zip(("vx", "vy", "vz"), v, strict=True))
        for t, r, v in zip(t_s, r_km, v_km_s, strict=True)
    ]


def test_sampled_orbits_are_used_where_the_truth_has_them():
    truth = little_truth()
    t_s = np.arange(-10.0, 50.0, 10.0)
    low = [7000.0, 0.01, 0.9, 0.2, 0.3, 0.4]
    samples = [*sampled(40, low, t_s), *sampled(7, RINGS[0], t_s)]
    samples = [samples[i] for i in np.random.default_rng(2).permutation(len(samples))]
    truth = dataclasses.replace(truth, orbits=rows(TRUE_ORBITS, *samples))
    objects, at_s = np.array([40, 7, 40, 40, 7]), np.array([3.0, 17.5, 39.9, 0.0, 20.0])
    found = locate_objects(truth, objects, T0_NS + (at_s * SECOND_NS).astype(np.int64))
    elements = np.where(objects[:, None] == 40, low, RINGS[0])
    r_km, v_km_s = state_at(elements, at_s)
    np.testing.assert_allclose(found[0], r_km, atol=METRE)
    np.testing.assert_allclose(found[1], v_km_s, atol=10 * MM_S)


def test_objects_move_by_their_elements_where_the_truth_has_no_samples():
    (r_km,), (v_km_s,) = locate_objects(little_truth(), np.array([1]), np.array([T0_NS]))
    assert r_km == pytest.approx([42000.0, 0.0, 0.0])
    assert v_km_s == pytest.approx([0.0, np.sqrt(398600.4418 / 42000.0), 0.0])

"""Clock search: the offset at which a sensor sees the others' objects; None where it is chance."""

import numpy as np
import pytest
from scenes.late_sensors import SENSORS, orbit

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.sensor_faults.clock_search import CandidatePairs, search_offset
from epipole.tasks.algorithms.simulation.paths import state_at

SIGMA = 2.0 * ARCSEC
PLACE_KM = 0.05
POSITION_KM = 0.7


def meetings(
    seed, offset, *, n=9, strays=0, epochs=5, missing=(), position_km=POSITION_KM, steady_km=0.0
):
    """Return all views of a sensor, late by an offset, paired with all objects of their epochs.

    Positions of objects have errors of `position_km` that are new at each epoch, and of `steady_km`
    that are not.
    """
    rng = np.random.default_rng(seed)
    t = np.arange(epochs) * 12.0
    bias, shared = rng.normal(size=(2, 3)) * PLACE_KM
    r, v_sensor = state_at(SENSORS[1], t)
    here, _ = state_at(SENSORS[1], t - offset)
    elements = [
        orbit(42164.0 + rng.normal() * 100, rng.normal() * 0.3, 0.0, 158.0 + 0.1 * k)
        for k in range(n)
    ]
    objects = [state_at(e, t) for e in elements]
    seen = [state_at(e, t - offset)[0] for k, e in enumerate(elements) if k not in missing]
    for _ in range(strays):
        base = state_at(orbit(42164.0, rng.normal(), 0.0, 158 + 2 * rng.normal()), t)[0]
        seen.append(base + rng.normal(size=3) * 500)
    steady = np.random.default_rng([seed, 1]).normal(size=(n, 3)) * steady_km
    rows = []
    for k, place in enumerate(seen):
        u = place - here
        u /= np.linalg.norm(u, axis=1)[:, None]
        u = u + np.einsum("ni,nij->nj", rng.normal(size=(epochs, 2)) * SIGMA, tangent_basis(u))
        u /= np.linalg.norm(u, axis=1)[:, None]
        for j, (x, v) in enumerate(objects):
            x = x + shared + steady[j] + rng.normal(size=(epochs, 3)) * position_km
            rows += [(k, j, u[i], r[i] + bias, v_sensor[i], x[i], v[i]) for i in range(epochs)]
    tracklet, number, u, r, v_sensor, x, v = (np.array(c) for c in zip(*rows, strict=True))
    size = len(rows)
    return CandidatePairs(
        tracklet, number, u, np.tile(np.eye(2) * SIGMA**2, (size, 1, 1)), np.zeros((size, 2, 2)),
        r, v_sensor, np.full(size, PLACE_KM), x, v,
        np.tile(np.eye(3) * (position_km**2 + steady_km**2), (size, 1, 1)),
    )  # fmt: skip


@pytest.mark.parametrize("offset", [-2.0, -0.3, 0.2, 1.0, 2.0, 4.0])
def test_an_offset_of_seconds_is_found_and_each_line_meets_its_own_object(offset):
    for seed in range(5):
        given = meetings(seed, offset)
        match = search_offset(given)
        assert abs(match.offset_s - offset) < 0.1  # 0.8 km: the error of the positions
        assert (given.tracklet[match.row] == given.object[match.row]).all()
        assert len(match.row) > 0.9 * 9 * 5


@pytest.mark.parametrize("offset", [-2.0, 1.0])
def test_errors_that_all_epochs_share_do_not_hide_it(offset):
    # The mean of 60 epochs is no better than one: by chance it is as far off as by one error.
    for seed in range(12):
        given = meetings(seed, offset, epochs=60, position_km=0.1, steady_km=0.7)
        match = search_offset(given)
        assert match is not None
        assert abs(match.offset_s - offset) < 0.5  # 1.5 km: two of these errors


def test_strays_and_objects_that_were_missed_do_not_hide_it():
    given = meetings(1, -1.5, strays=20, missing=(2, 5))
    match = search_offset(given)
    assert abs(match.offset_s + 1.5) < 0.1
    assert set(given.object[match.row]) == {0, 1, 3, 4, 6, 7, 8}


def test_agreement_by_chance_is_no_offset():
    found = [search_offset(meetings(s, 0.0, strays=12, missing=range(9))) for s in range(30)]
    assert found == [None] * 30


def test_two_objects_are_too_few():
    assert search_offset(meetings(2, 1.0, n=2)) is None


def test_an_offset_beyond_the_search_is_not_found():
    assert search_offset(meetings(3, 8.0)) is None


def test_no_lines_give_none():
    assert search_offset(CandidatePairs(*(values[:0] for values in meetings(4, 0.0, n=1)))) is None

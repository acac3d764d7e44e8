"""States against the truth."""

import polars as pl
import pytest
from scenes.little_night import little_state, little_truth, rows

from epipole.schemas.bridge import empty
from epipole.schemas.tables import STATES
from epipole.tasks.evaluate.measures import measure_states


def matched(**true_objects):
    """Return the positions of each id, by their true objects."""
    pairs = [(name, k) for name, values in true_objects.items() for k in values]
    schema = {"object_id": pl.String, "true_object": pl.Int64}
    return pl.DataFrame(pairs, schema=schema, orient="row")


def measure(positions, *states):
    return measure_states(rows(STATES, *states), positions, little_truth())


def test_nees_counts_position_and_velocity():
    off = little_state("o1", x_km=1.0, vy_km_s=0.03)  # 2 and 3 sigma
    far = little_state("o1", x_km=2.5)  # 5 sigma
    found = measure(matched(o1=[0]), off, far)
    assert found["states_nees_max"] == pytest.approx(25.0, rel=1e-6)
    assert found["states_nees_median"] == pytest.approx((13 + 25) / 2, rel=1e-6)
    assert found["states_nees_mean"] == pytest.approx((13 + 25) / 2 / 6, rel=1e-6)
    assert found["states_in_99"] == 0.5
    assert found["states_err_km_median"] == pytest.approx(1.75, rel=1e-9)


def test_a_covariance_between_position_and_velocity_counts():
    off = little_state("o1", x_km=0.5, vy_km_s=0.01, cov_xvy=0.8 * 0.5 * 0.01)
    found = measure(matched(o1=[0]), off)
    assert found["states_nees_median"] == pytest.approx(2 / 1.8, rel=1e-6)


def test_a_state_is_of_what_most_positions_of_its_id_are_of():
    state = little_state("o1")
    right = measure(matched(o1=[1, 0, 0, -1, -1, -1]), state)
    assert right["states_err_km_median"] == pytest.approx(0.0, abs=1e-6)
    earlier = measure(matched(o1=[1, 0, 0, 1]), state)
    assert earlier["states_err_km_median"] == pytest.approx(164.0)


def test_a_state_of_an_id_without_an_object_is_of_nothing():
    states = [little_state(name) for name in ("o1", "o2", "o3")]
    found = measure(matched(o1=[0], o2=[-1]), *states)
    assert (found["states"], found["states_of_nothing"]) == (1, 2)
    assert measure(matched(o2=[-1]), *states) == {"states": 0, "states_of_nothing": 3}
    assert measure_states(empty(STATES), matched(o1=[0]), little_truth()) == {"states": 0}

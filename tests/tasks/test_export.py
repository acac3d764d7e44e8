"""Ephemerides of objects: through the arc, exact at the epoch, covariances that grow with it."""

import numpy as np
import polars as pl
import pytest
from scenes.little_night import little_state, rows

from epipole.schemas.bridge import to_polars
from epipole.schemas.tables import POSITIONS, STATES
from epipole.tasks.export import HALF_ARC_S, arcs, single_states


def tables(*since_s: float) -> tuple[pl.DataFrame, pl.DataFrame]:
    """A state of the little night's object, and positions so many seconds after it."""
    states = to_polars(rows(STATES, little_state("o1", cov_xy=0.1)))
    places = to_polars(rows(POSITIONS, *[{"object_id": "o1"} for _ in since_s] or [{}]))
    epoch = states["epoch"][0]
    at = [epoch + pl.duration(microseconds=round(s * 1e6)) for s in since_s]
    return states, places.head(len(since_s)).with_columns(
        epoch=pl.concat_list(at).explode() if at else pl.col("epoch")
    )


def test_an_arc_covers_the_positions_about_its_epoch():
    states, positions = tables(-100.0, -3.0, 0.0, 250.0, 290.0, HALF_ARC_S + 5)
    (arc,) = arcs(states, positions)
    epoch_ns = states["epoch"].dt.epoch("ns")[0]
    assert np.all(np.diff(arc.time_ns) > 0)
    assert [(t - epoch_ns) / 1e9 for t in arc.time_ns[[0, -1]]] == [-100.0, 290.0]
    assert epoch_ns in arc.time_ns


def test_the_state_itself_is_in_it_and_its_covariance():
    states, positions = tables(-100.0, 100.0)
    (arc,), (alone,) = arcs(states, positions), single_states(states)
    at = int(np.flatnonzero(arc.time_ns == alone.time_ns[0])[0])
    assert np.array_equal(arc.state[at], alone.state[0])
    assert arc.covariance_ns.tolist() == [arc.time_ns[0], alone.time_ns[0], arc.time_ns[-1]]
    assert arc.covariance[1] == pytest.approx(alone.covariance[0])
    assert alone.covariance[0][0, 1] == alone.covariance[0][1, 0] == pytest.approx(0.1)


def test_positions_move_by_the_velocity_and_their_covariance_by_its_error():
    states, positions = tables(-200.0, 200.0)
    (arc,) = arcs(states, positions)
    dt = (arc.time_ns[-1] - arc.covariance_ns[1]) / 1e9
    middle = arc.state[arc.time_ns == arc.covariance_ns[1]][0]
    straight = middle[:3] + middle[3:] * dt
    fall = 398600.4418 / middle[0] ** 2 * dt**2 / 2
    assert np.linalg.norm(arc.state[-1, :3] - straight) == pytest.approx(fall, rel=0.02)
    grown = arc.covariance[2][2, 2]
    assert grown == pytest.approx(0.5**2 + (0.01 * dt) ** 2, rel=0.01)


def test_a_state_without_positions_is_two_seconds_long():
    (arc,) = arcs(*tables())
    assert arc.time_ns[-1] - arc.time_ns[0] == 2e9

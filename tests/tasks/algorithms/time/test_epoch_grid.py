"""Epochs: a grid from midnight, and the frame nearest to each."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from epipole.tasks.algorithms.constants import DAY_NS
from epipole.tasks.algorithms.time.epoch_grid import (
    epoch_grid,
    epoch_interval_ns,
    frame_interval_ns,
    nearest_frame,
)

NIGHT = 1_554_076_800_000_000_000  # 2019-04-01 00:00 UTC
SECOND = 1_000_000_000


@given(st.integers(0, 3 * DAY_NS), st.integers(0, 2 * DAY_NS), st.integers(10 * SECOND, DAY_NS))
def test_the_grid_holds_every_multiple_since_midnight_and_no_other(start, length, step):
    first, last = NIGHT + start, NIGHT + start + length
    epochs = epoch_grid(first, last, step)
    assert ((epochs >= first) & (epochs <= last)).all()
    assert (np.diff(epochs) > 0).all()
    assert ((epochs - NIGHT) % DAY_NS % step == 0).all()
    days = range(start // DAY_NS, (start + length) // DAY_NS + 1)
    everything = [NIGHT + d * DAY_NS + k for d in days for k in range(0, DAY_NS, step)]
    assert epochs.tolist() == [t for t in everything if first <= t <= last]


def test_the_slowest_sensor_sets_the_interval_and_jitter_does_not_move_it():
    rng = np.random.default_rng(0)
    slow = np.arange(100) * SECOND + rng.integers(-1000, 1000, 100)
    fast = np.arange(1000) * SECOND // 5
    assert epoch_interval_ns([fast, slow]) == SECOND
    assert epoch_interval_ns([fast]) == SECOND // 5


def test_a_single_frame_still_has_an_interval():
    assert frame_interval_ns(np.array([NIGHT])) == 0
    assert epoch_interval_ns([np.array([NIGHT])]) > 0
    assert epoch_interval_ns([]) > 0


@given(st.lists(st.integers(0, 1000), min_size=1, unique=True), st.lists(st.integers(-100, 1100)))
def test_the_nearest_frame_is_nearest_and_the_earlier_of_two(times, wanted):
    times, wanted = np.sort(np.array(times)), np.array(wanted, np.int64)
    got = nearest_frame(wanted, times)
    for epoch, frame in zip(wanted, got, strict=True):
        assert frame == np.argmin(np.abs(times - epoch))


def test_no_time_gives_no_epoch():
    assert len(epoch_grid(NIGHT + 1, NIGHT + 2, SECOND)) == 0


@pytest.mark.parametrize("n", [1, 2])
def test_a_frame_twice_counts_once_for_the_interval(n):
    assert frame_interval_ns(np.repeat(np.arange(5) * SECOND, n)) == SECOND

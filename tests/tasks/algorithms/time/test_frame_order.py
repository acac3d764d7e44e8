"""The order of frames, and which are duplicates."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from epipole.tasks.algorithms.time.frame_order import (
    DUPLICATE_FRAME,
    DUPLICATE_NUMBER,
    DUPLICATE_TIME,
    KEEP,
    order_frames,
    order_states,
)


def verdicts(*frames):
    """Return (sensor, time, number, verdict) of frames, in the order found."""
    columns = np.array(frames, np.int64).reshape(-1, 3).T
    order, verdict = order_frames(*columns)
    return [(*frames[i], int(v)) for i, v in zip(order, verdict, strict=True)]


def test_frames_are_sorted_by_sensor_then_time():
    assert verdicts((1, 5, 0), (0, 9, 8), (0, 7, 6)) == [
        (0, 7, 6, KEEP),
        (0, 9, 8, KEEP),
        (1, 5, 0, KEEP),
    ]


def test_a_frame_that_comes_three_times_counts_once():
    found = verdicts((0, 7, 6), (0, 7, 6), (0, 7, 6), (0, 8, 7))
    assert [f[3] for f in found] == [KEEP, DUPLICATE_FRAME, DUPLICATE_FRAME, KEEP]


def test_of_one_number_at_two_times_the_first_in_time_is_kept():
    found = verdicts((0, 9, 1), (0, 8, 0), (0, 3, 1), (1, 9, 1))
    assert found == [
        (0, 3, 1, KEEP),
        (0, 8, 0, KEEP),
        (0, 9, 1, DUPLICATE_NUMBER),
        (1, 9, 1, KEEP),
    ]


def test_copies_of_a_frame_that_repeats_a_number_repeat_it_too():
    found = verdicts((0, 3, 1), (0, 9, 1), (0, 9, 1))
    assert [f[3] for f in found] == [KEEP, DUPLICATE_NUMBER, DUPLICATE_NUMBER]


def test_two_numbers_at_one_time_are_one_exposure():
    found = verdicts((0, 3, 2), (0, 3, 1), (0, 3, 2))
    assert [f[2:] for f in found] == [(1, KEEP), (2, DUPLICATE_TIME), (2, DUPLICATE_TIME)]


FRAMES = st.lists(st.tuples(st.integers(0, 2), st.integers(0, 5), st.integers(0, 5)), max_size=30)


@given(FRAMES, st.randoms(use_true_random=False))
def test_kept_frames_are_unique_and_do_not_depend_on_the_order_given(frames, random):
    shuffled = list(frames)
    random.shuffle(shuffled)
    found = verdicts(*frames)
    assert found == verdicts(*shuffled)
    kept = [f[:3] for f in found if f[3] == KEEP]
    assert kept == sorted(kept)
    assert len({(s, t) for s, t, _ in kept}) == len(kept) == len({(s, n) for s, _, n in kept})
    assert {s for s, *_ in kept} == {s for s, *_ in frames}


def test_states_of_one_time_count_once_and_the_first_given_is_kept():
    order, repeats = order_states(np.array([1, 0, 1, 1]), np.array([5, 9, 5, 4]))
    assert list(order) == [1, 3, 0, 2]
    assert list(repeats) == [False, False, False, True]

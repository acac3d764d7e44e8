"""Arguments of the public functions."""

import datetime

import numpy as np
import pytest

from epipole.flows.api.arguments import floats, time_ns

NS = 1_554_091_200_000_000_000


@pytest.mark.parametrize(
    "time",
    [
        NS,
        np.int64(NS),
        "2019-04-01T04:00:00",
        "2019-04-01T06:00:00+02:00",
        np.datetime64("2019-04-01T04:00"),
        datetime.datetime(2019, 4, 1, 4),
        datetime.datetime(2019, 4, 1, 4, tzinfo=datetime.UTC),
    ],
)
def test_times_are_nanoseconds_since_1970(time):
    assert time_ns(time) == NS


@pytest.mark.parametrize("time", [None, 1.5, "tomorrow", np.datetime64("NaT"), True])
def test_what_is_no_time_is_named(time):
    with pytest.raises(ValueError, match=r"^time: "):
        time_ns(time)


def test_a_wrong_shape_is_one_clear_error():
    with pytest.raises(ValueError, match=r"^y_px: has shape \(3,\), expected \(4,\)$"):
        floats("y_px", [1, 2, 3], 4)
    with pytest.raises(ValueError, match=r"^u: has shape \(2, 2\), expected \(n, 3\)$"):
        floats("u", np.zeros((2, 2)), "n", 3)
    with pytest.raises(ValueError, match=r"^u: not an array of numbers"):
        floats("u", ["a"], "n")


def test_values_are_repeated_only_where_they_may_be():
    assert floats("s", 0.5, 3, repeat=True).tolist() == [0.5] * 3
    assert floats("c", np.eye(2), 3, 2, 2, repeat=True).shape == (3, 2, 2)
    assert floats("c", None, 3, default=2.0).tolist() == [2.0] * 3
    with pytest.raises(ValueError, match=r"^s: has shape \(\), expected \(3,\)$"):
        floats("s", 0.5, 3)

"""Arguments of the public functions."""

import datetime

import numpy as np
import pytest

from epipole.flows import api
from epipole.flows.api.arguments import floats, integers, nanoseconds, optics, time_ns

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


@pytest.mark.parametrize("unit", [1, 1_000, 1_000_000])
def test_integers_of_another_unit_than_nanoseconds_are_refused(unit):
    with pytest.raises(ValueError, match=r"^time: .* ns is before 1972, expected nanoseconds"):
        time_ns(NS // 1_000_000_000 * unit)


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


def test_masked_values_are_no_values():
    with pytest.raises(ValueError, match=r"^x: has 1 masked values; leave them out, or fill them$"):
        floats("x", np.ma.array([1.0, 2.0], mask=[False, True]), "n")
    assert floats("x", np.ma.array([1.0, 2.0]), "n").tolist() == [1.0, 2.0]


@pytest.mark.parametrize("time", ["2263-01-01", "1600-01-01", "2600-01-01T00:00:00.000"])
def test_times_beyond_nanoseconds_are_refused_and_do_not_wrap(time):
    with pytest.raises(ValueError, match=r"^time: .* is beyond the years 1678 to 2261$"):
        time_ns(np.datetime64(time))
    with pytest.raises(ValueError, match=r"^t: .* is beyond"):
        nanoseconds("t", np.array(["2019-01-01", time], "datetime64[s]"))
    with pytest.raises(ValueError, match=r"^time: .* is beyond"):
        api.attributable(np.array([time], "datetime64[D]"), [1.0], [1.0], 1.0)


@pytest.mark.parametrize(
    ("change", "reason"),
    [({"fx_px": -14666.0}, "bad_camera_matrix"), ({"width": 0}, "bad_image_size"),
     ({"k1": float("nan")}, "bad_distortion"), ({"line_time_s": 1.0}, "bad_line_time"),
     ({"fx_px": "long"}, "is no Camera"), ({"width": 10.5}, "expected whole")],
)  # fmt: skip
def test_a_camera_that_a_log_may_not_have_is_refused(change, reason):
    good = api.Camera(512, 512, 14666.0, 14666.0, 255.5, 255.5)
    assert optics("camera", tuple(good)) == good
    bad = good._replace(**change)
    with pytest.raises(ValueError, match=f"^camera: .*{reason}"):
        optics("camera", bad)
    with pytest.raises(ValueError, match=r"^camera: "):
        api.identify_frame([1.0], [1.0], camera=bad, time=NS)
    with pytest.raises(ValueError, match=r"^camera: "):
        api.view_frame([1.0], [1.0], camera=bad, attitude_xyzw=[0, 0, 0, 1], sigma_px=0.1,
                       position_km=[7000.0, 0, 0], velocity_km_s=[0.0, 0, 0])  # fmt: skip


def test_whole_numbers_stay_whole():
    assert integers("n", [1, -1], 2).tolist() == [1, -1]
    assert integers("n", np.array([2.0]), 1).tolist() == [2]
    with pytest.raises(ValueError, match=r"^n: has 0.5, expected whole numbers$"):
        integers("n", [1.0, 0.5], 2)
    with pytest.raises(ValueError, match=r"^n: has nan, expected whole numbers$"):
        integers("n", [np.nan], 1)

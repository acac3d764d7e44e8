"""Frames over the night: what they became, gaps, and sums that do not depend on the pieces."""

import numpy as np
import pytest
from scenes.made_nights import START_NS, filled, reader_of, seconds

from epipole.tasks.report.frame_series import read_frame_series


def night(in_group=1000, count=400):
    time = seconds(count)
    time = np.concatenate([time[:200], time[300:]])
    half = len(time) // 2
    return reader_of({
        "frames": filled(
            "frames", sensor_id=["a"] * len(time), time=time,
            attitude_source=["stars"] * half + ["prior"] * (half - 10) + ["none"] * 10,
            status=[None] * half + ["no_match"] * half, n_stars=[7] * half + [0] * half,
            sigma_x_arcsec=[3.0] * half + [None] * half, residual_px=[0.2] * half + [None] * half,
            sigma_y_arcsec=[4.0] * half + [None] * half,
            sigma_z_arcsec=[50.0] * half + [None] * half)}, in_group=in_group)  # fmt: skip


def test_frames_are_counted_by_the_source_of_their_attitude():
    series = read_frame_series(night())
    assert series.counts.sum(axis=(1, 2)).tolist() == [150, 140, 10]
    assert series.failed == {("a", "no_match"): 150}
    assert series.identified_share.tolist() == [0.5]
    assert series.stars.tolist() == [7.0]


def test_a_time_without_frames_is_a_gap():
    series = read_frame_series(night())
    (gap,) = series.gaps
    assert gap.seconds == 101
    assert gap.start_ns == START_NS + 199 * 10**9
    assert series.lost_s.tolist() == [101]


def test_a_sensor_that_begins_late_and_stops_early_has_gaps_at_both_ends():
    time = seconds(100)
    rows = [(t, s) for k, t in enumerate(time) for s in ("a", "b") if s == "a" or 20 <= k < 70]
    frames = filled("frames", time=[t for t, _ in rows], sensor_id=[s for _, s in rows],
                    attitude_source=["none"] * len(rows))  # fmt: skip
    for in_group in (7, 1000):
        series = read_frame_series(reader_of({"frames": frames}, in_group=in_group))
        assert [(gap.sensor_id, gap.seconds) for gap in series.gaps] == [("b", 20), ("b", 30)]
        assert series.lost_s.tolist() == [0, 50]


def test_a_sensor_with_one_frame_has_gaps_before_and_after_it():
    time = seconds(100)
    of_sensor = ["a"] * 20 + ["b"] + ["a"] * 80
    frames = filled("frames", time=[*time[:21], *time[20:]], sensor_id=of_sensor,
                    attitude_source=["none"] * 101)  # fmt: skip
    for in_group in (7, 1000):
        series = read_frame_series(reader_of({"frames": frames}, in_group=in_group))
        assert [(gap.sensor_id, gap.seconds) for gap in series.gaps] == [("b", 20), ("b", 79)]
        assert series.lost_s.tolist() == [0, 99]


def test_sigmas_are_root_mean_squares():
    series = read_frame_series(night())
    assert np.nanmax(abs(series.rms["across"] - np.sqrt(12.5))) < 1e-12
    assert np.nanmax(abs(series.rms["about"] - 50)) < 1e-12


def test_pieces_of_a_table_change_nothing():
    whole, pieces = read_frame_series(night()), read_frame_series(night(in_group=7))
    assert (whole.counts == pieces.counts).all()
    assert whole.gaps == pieces.gaps


def test_a_night_without_frames_has_no_series():
    assert read_frame_series(reader_of({})) is None


@pytest.mark.parametrize(
    ("source", "centroids", "no_stars"), [("prior", 1, True), ("prior", 30, False), ("none", 1, 0)]
)
def test_a_sensor_that_sends_attitudes_and_no_stars_is_known(source, centroids, no_stars):
    frames = filled("frames", time=seconds(50), sensor_id=["a"] * 50,
                    attitude_source=[source] * 50, n_centroids=[centroids] * 50)  # fmt: skip
    assert read_frame_series(reader_of({"frames": frames})).sends_no_stars.tolist() == [no_stars]

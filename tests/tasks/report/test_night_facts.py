"""All facts of a night, from a real small run and from made-up ones."""

import numpy as np
import polars as pl
import pytest
from scenes.made_nights import filled, hostile_night, reader_of, seconds

from epipole.io.datasets.dataset import night_reader
from epipole.tasks.report import object_details
from epipole.tasks.report.night_facts import look_first, needs_look, read_night_facts
from epipole.tasks.report.object_details import read_object_details

NIGHT = "2019-04-01"


@pytest.fixture(scope="module")
def facts(night_dataset):
    return read_night_facts(night_reader(night_dataset, NIGHT), "out")


def test_a_healthy_night_needs_no_look(facts):
    assert needs_look(facts) == []


def test_the_counts_are_those_of_the_tables(facts):
    assert facts.counts["frames"] == facts.trend[-1].frames == facts.series.frames.sum()
    assert facts.trend[-1].objects == len(facts.objects) == 9
    assert sum(facts.tracks.counts.values()) == facts.counts["tracklets"]


def test_epipolar_lines_pass_the_detections(facts):
    assert len(facts.epipolar.lines) == 9
    for line in facts.epipolar.lines:
        assert line.distance_px < 1.0
        start, end = line.line_px[0], line.line_px[-1]
        along = (end - start) / np.linalg.norm(end - start)
        off = line.seen_px - start
        distance = abs(off[0] * along[1] - off[1] * along[0])
        assert abs(distance - line.distance_px) < 0.2


def test_the_map_is_of_one_frame(facts):
    frame = facts.star_map
    assert len(frame.star_id) == len(frame.stars_px) == len(frame.residuals_px) > 3
    assert abs(len(frame.star_id) - facts.series.stars.max()) < 5


def test_an_empty_night_has_no_facts_and_says_so():
    facts = read_night_facts(reader_of({}), "out")
    assert facts.series is None
    assert needs_look(facts) == [("The night has no frames.", "coverage")]


def test_a_sensor_at_fault_stands_first():
    sentences = needs_look(read_night_facts(hostile_night("s1"), "out"))
    assert sentences[0].sentence.startswith("s1 is at fault (clock_off)")
    (share,) = [
        each for each in sentences if "50.0 % of its frames are identified" in each.sentence
    ]
    assert share.anchor == "frame-1"


def test_residuals_of_zero_need_a_look():
    n = 40
    pairs = filled("pairs", epoch=seconds(n), mahalanobis=[0.0] * n)
    looks = needs_look(read_night_facts(reader_of({"pairs": pairs}), "out"))
    says = "Sigmas of pair distances do not hold: the residuals are 1000.00 times smaller."
    assert says in [look.sentence for look in looks]


def test_the_frame_concerned_is_one_that_is_not_identified():
    facts = read_night_facts(hostile_night("s1"), "out")
    (frame,) = facts.concerned.values()
    assert (frame.sensor_id, frame.status) == ("s1", "s1")
    assert frame.frame_number >= 6
    assert len(frame.star_id) == 0


def test_frames_of_sensors_that_are_equally_bad_are_in_the_order_of_their_names():
    names = ["d", "b", "c", "a"] * 6
    frames = filled("frames", sensor_id=names, time=seconds(24), frame_number=np.arange(24),
                    attitude_source=["none"] * 24, status=["no_match"] * 24)  # fmt: skip
    facts = read_night_facts(reader_of({"frames": frames}), "out")
    assert list(facts.concerned) == ["a", "b", "c", "d"]


def test_an_object_has_its_observations_and_its_orbit(facts):
    assert [each.object_id for each in facts.details] == [
        each.object_id for each in look_first(facts.objects)
    ]
    for each in facts.details:
        assert each.orbit["object_id"] == each.object_id
        assert each.by_sensor["count"].sum() >= len(each.seen) > 50
        fitted = each.by_sensor.select(pl.col("count").dot("mean_square") / pl.col("count").sum())
        assert 1.5 < fitted.item() < 2.6


def test_of_many_observations_some_are_kept(monkeypatch, night_dataset):
    monkeypatch.setattr(object_details, "MAX_DOTS", 90)
    made = read_object_details(night_reader(night_dataset, NIGHT), ["20190401-00001"])
    assert made[0].step == 3
    assert len(made[0].seen) == -(-made[0].by_sensor["count"].sum() // 3)

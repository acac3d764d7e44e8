"""All facts of a night, from a real small run and from made-up ones."""

import numpy as np
import pytest
from scenes.made_nights import hostile_night, reader_of

from epipole.io.datasets.dataset import night_reader
from epipole.tasks.report.night_facts import needs_look, read_night_facts

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
    assert needs_look(facts) == ["The night has no frames."]


def test_a_sensor_at_fault_stands_first():
    sentences = needs_look(read_night_facts(hostile_night("s1"), "out"))
    assert sentences[0].startswith("s1 is at fault (clock_off)")
    assert any("50.0 % of its frames are identified" in sentence for sentence in sentences)

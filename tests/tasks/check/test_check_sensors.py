"""Check of sensors: what was corrected and what remains; nothing from nothing."""

import numpy as np

from epipole.io.work.parts import SOLVED, write_part
from epipole.io.work.work_layout import SolvedParts, ViewedParts
from epipole.schemas.bridge import empty, to_polars
from epipole.schemas.spans import SPAN_NS, Sensor, Span
from epipole.schemas.tables import POSITIONS
from epipole.schemas.work_tables import CLOCK_LINES, VIEWS
from epipole.tasks.check.check_sensors import (
    JudgedSights,
    SensorVerdict,
    add_corrections,
    check_sensors,
    sensor_verdicts,
)
from epipole.tasks.solve.positions import solve_positions
from epipole.tasks.solve.sample_sight_lines import LineSampling, moving_objects, sample_sight_lines
from epipole.tasks.solve.view_groups import unpack_views

LATE = SensorVerdict("a", 0.25, 0.01, "clock")
EARLY = SensorVerdict("b", -0.5, 0.01, "clock")
SOUND = SensorVerdict("c", 0.01, 0.01)


def test_an_offset_is_the_correction_and_what_remains_of_it():
    remaining = [SensorVerdict("a", 0.001, 0.008), SOUND]
    total = add_corrections([LATE, EARLY], remaining)
    assert [clock.sensor_id for clock in total] == ["a", "b", "c"]
    assert total[0] == SensorVerdict("a", 0.251, 0.008, "clock")
    assert total[1:] == [EARLY, SOUND]


def test_without_views_no_clock_is_known():
    objects = moving_objects(empty(POSITIONS), 13_000_000_000)
    views = unpack_views(empty(VIEWS), np.zeros(0, np.int64))
    groups = solve_positions(views, reject_sigma=5.0)
    lines = sample_sight_lines(groups, objects, LineSampling(1))
    assert lines.equals(empty(CLOCK_LINES))
    assert sensor_verdicts(to_polars(lines)) == JudgedSights([])
    assert sensor_verdicts(to_polars(lines), {"a": 0.5}) == JudgedSights([])


def test_without_objects_no_clock_is_known(tmp_path):
    solved, spans = SolvedParts(tmp_path), [Span(k * SPAN_NS, (k + 1) * SPAN_NS) for k in (7, 8)]
    sensors = ViewedParts(tmp_path / "views"), [Sensor(0, "a")]
    assert check_sensors.fn(solved, *sensors, spans) == JudgedSights([])
    tables = {name: empty(schema) for name, schema in SOLVED.items()}
    write_part(solved.piece(spans[1], 0), SOLVED, tables)
    assert check_sensors.fn(solved, *sensors, spans) == JudgedSights([])

"""Check of sensors: what was corrected and what remains; nothing from nothing."""

from epipole.schemas.bridge import empty, to_polars
from epipole.schemas.settings import Settings
from epipole.schemas.tables import ASSOCIATIONS, POSITIONS
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.check.check_sensors import SensorVerdict, as_in_the_logs, verdicts_of
from epipole.tasks.solve.collect_clock_views import collect_clock_views

LATE = SensorVerdict("a", 0.25, 0.01, "clock")
EARLY = SensorVerdict("b", -0.5, 0.01, "clock")
SOUND = SensorVerdict("c", 0.01, 0.01)


def test_an_offset_is_the_correction_and_what_remains_of_it():
    remaining = [SensorVerdict("a", 0.001, 0.008), SOUND]
    total = as_in_the_logs([LATE, EARLY], remaining)
    assert [clock.sensor_id for clock in total] == ["a", "b", "c"]
    assert total[0] == SensorVerdict("a", 0.251, 0.008, "clock")
    assert total[1:] == [EARLY, SOUND]


def test_without_views_no_clock_is_known():
    tables = (empty(s) for s in (VIEWS, VIEWS, ASSOCIATIONS, POSITIONS))
    assert verdicts_of(to_polars(collect_clock_views(*tables, Settings()))) == []

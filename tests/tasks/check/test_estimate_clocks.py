"""Estimate clocks: what was corrected and what remains; nothing from nothing."""

from epipole.schemas.bridge import empty, to_polars
from epipole.schemas.settings import Settings
from epipole.schemas.tables import ASSOCIATIONS, POSITIONS
from epipole.schemas.work_tables import SOLUTIONS, VIEWS
from epipole.tasks.check.estimate_clocks import Clock, clocks_of, total_offsets
from epipole.tasks.solve.collect_clock_views import collect_clock_views

LATE, EARLY, SOUND = Clock("a", 0.25, 0.01, True), Clock("b", -0.5, 0.01, True), Clock(
    "c", 0.01, 0.01, False
)  # fmt: skip


def test_an_offset_is_the_correction_and_what_remains_of_it():
    remaining = [Clock("a", 0.001, 0.008, False), SOUND]
    total = total_offsets([LATE, EARLY], remaining)
    assert [clock.sensor_id for clock in total] == ["a", "b", "c"]
    assert total[0] == Clock("a", 0.251, 0.008, True)
    assert total[1:] == [EARLY, SOUND]


def test_without_views_no_clock_is_known():
    tables = (empty(s) for s in (VIEWS, ASSOCIATIONS, POSITIONS, SOLUTIONS))
    assert clocks_of(to_polars(collect_clock_views(*tables, Settings()))) == []

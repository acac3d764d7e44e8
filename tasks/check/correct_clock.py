"""Correct a clock: one sensor's identified frames of a span at their true times."""

from pathlib import Path

from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.io.work.files import is_written, read_part, write_part
from epipole.schemas.settings import Settings
from epipole.tasks.check.estimate_clocks import Clock, set_clocks, set_places
from epipole.tasks.common.spans import Sensor, Span
from epipole.tasks.identify.identify_span import states_about
from epipole.tasks.identify.place_sensors import place_sensors


@task(name="correct clock", task_run_name="correct clock {sensor} {span}", cache_policy=NO_CACHE)
def correct_clock(
    frames: Path,
    sensor: Sensor,
    identified: Path,
    span: Span,
    clock: Clock,
    settings: Settings,
    stage: Path,
) -> None:
    """Set a part's frames to their true times, and their sensor to where it then was."""
    part = stage / span.folder
    if is_written(part):
        return
    before = identified / span.folder
    names = ("solutions", "stars", "detections")
    tables = {name: set_clocks(read_part(before, name), [clock]) for name in names}
    solutions = tables["solutions"]
    states = states_about(frames, sensor, span, settings)
    tables["solutions"] = set_places(solutions, place_sensors(solutions, states, settings))
    write_part(part, {**tables, "rejects": read_part(before, "rejects")})

"""Objects found with clocks that may be wrong: what the residuals of positions show of them."""

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from epipole.flows.night.stages import set_clocks_right, solve, track
from epipole.flows.night.work import Work
from epipole.flows.prefect.progress import step
from epipole.io.work.files import read_part
from epipole.schemas.settings import Settings
from epipole.tasks.check.estimate_clocks import Clock, added, estimate_clocks
from epipole.tasks.solve.solve_span import SensorParts

LOGGER = logging.getLogger(__name__)


class Found(NamedTuple):
    """Where the objects of a night lie, and what they were found with."""

    work: Work
    parts: list[SensorParts]
    solved: Path
    clocks: list[Clock]  # as the logs have them


def find_objects(work: Work, settings: Settings) -> Found:
    """Track, align, associate and solve; where the setting says so, again with clocks right.

    A clock that is off and stays so leaves its sensor out: it would spoil what the others see.
    """
    clocks: list[Clock] = []
    still: list[Clock] = []
    for attempt in (
        "",
        "-on-time",
        "-on-time-again",
    ):  # the second brings in a sensor that saw none
        if attempt:
            work = set_clocks_right(work, still, settings, attempt)
        parts = track(work, settings, attempt)
        solved = solve(work, parts, settings, attempt)
        still = _read_clocks(work, solved)
        clocks = added(clocks, still)
        if not settings.alignment.correct_clocks or not any(clock.is_off for clock in still):
            break
    wrong = _spoiling(work, solved, still)
    if wrong:
        solved = solve(work, parts, settings, "-without", wrong)
    return Found(work, parts, solved, clocks)


def _read_clocks(work: Work, solved: Path) -> list[Clock]:
    """Estimate each sensor's clock from all spans together."""
    step("estimate clocks", 0, 1)
    clocks: list[Clock] = estimate_clocks(solved, work.all_spans())
    for clock in clocks:
        if clock.is_off:
            LOGGER.warning("%s", clock)
        else:
            LOGGER.info("%s", clock)
    return clocks


def _spoiling(work: Work, solved: Path, clocks: Sequence[Clock]) -> list[str]:
    """Return the sensors whose clocks are off and that take part in an association.

    One that takes part in none spoils none.
    """
    off = {clock.sensor_id for clock in clocks if clock.is_off}
    taking_part: set[str] = set()
    for span in work.all_spans() if off else []:
        part = read_part(solved / span.folder, "associations", ["sensor_id"])
        taking_part |= off.intersection(part["sensor_id"].unique().to_pylist())
    return sorted(taking_part)

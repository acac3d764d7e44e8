"""Clocks of a night: what the positions show of them, and frames put right by it."""

import logging

import pyarrow as pa

from epipole.flows.progress import step
from epipole.flows.stages import place
from epipole.schemas.settings import Settings
from epipole.tasks.estimate_clocks import Clock, estimate_clocks, set_clocks, set_places
from epipole.tasks.identify_stars import Identified
from epipole.tasks.solve_positions import Solved

LOGGER = logging.getLogger(__name__)


def read_clocks(
    views: pa.Table, solved: Solved, identified: Identified, settings: Settings
) -> list[Clock]:
    """Estimate each sensor's clock from the residuals of the positions."""
    step("estimate clocks", 0, 1)
    clocks: list[Clock] = estimate_clocks(
        views, solved.associations, solved.positions, identified.solutions, settings
    )
    for clock in clocks:
        if clock.is_off:
            LOGGER.warning("%s", clock)
        else:
            LOGGER.info("%s", clock)
    return clocks


def set_right(
    identified: Identified,
    exposures: pa.Table,
    states: pa.Table,
    clocks: list[Clock],
    settings: Settings,
) -> tuple[Identified, pa.Table]:
    """Put frames and exposures at their true times, and their sensors where they then were."""
    exposures = set_clocks(exposures, clocks)
    places = place(exposures, states, settings)
    solutions = set_places(set_clocks(identified.solutions, clocks), places)
    identified = identified._replace(
        solutions=solutions,
        stars=set_clocks(identified.stars, clocks),
        detections=set_clocks(identified.detections, clocks),
    )
    return identified, exposures

"""Clocks of a night: what its spans together show of them."""

import logging
from collections.abc import Sequence

from epipole.tasks.estimate_clocks import Clock

LOGGER = logging.getLogger(__name__)


def read_clocks(parts: Sequence[Clock]) -> list[Clock]:
    """Return each sensor's clock over the night, of what the spans tell of it.

    What a sensor's frames share (its attitude's bias, its position's) the spans share too, so
    their mean is believed no more than the best of them.
    """
    clocks = []
    for sensor_id in sorted({clock.sensor_id for clock in parts}):
        own = [clock for clock in parts if clock.sensor_id == sensor_id]
        weights = [clock.sigma_s**-2 for clock in own]
        mean = sum(w * clock.offset_s for w, clock in zip(weights, own, strict=True)) / sum(weights)
        clocks.append(Clock(sensor_id, mean, min(clock.sigma_s for clock in own)))
    for clock in clocks:
        LOGGER.log(logging.WARNING if clock.is_off else logging.INFO, "%s", clock)
    return clocks

"""The checks of a night's logs: what was written otherwise than it says."""

import logging

import pyarrow as pa

from epipole.flows.night.progress import results
from epipole.flows.night.work import Work
from epipole.io.datasets.rows_by_night import rows_of_night
from epipole.schemas.bridge import concat
from epipole.schemas.log_checks import mistakes
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS, SPAN_NS, day_of
from epipole.schemas.stages import Stage
from epipole.schemas.tables import CHECKS
from epipole.tasks.check.judge_readings import judge_readings
from epipole.tasks.common.batches import Batch
from epipole.tasks.read.judge_logs import judge_logs, judged_sensors
from epipole.tasks.read.order_frames import OrderedFrames

LOGGER = logging.getLogger(__name__)

SENSORS_OF_TASK = 16


def check_logs(frames: OrderedFrames, night: str, settings: Settings) -> pa.Table:
    """Return CHECKS of the logs of a night, and of half an hour before and after it."""
    start_ns = day_of(night) * DAY_NS
    between_ns = (start_ns - SPAN_NS, start_ns + DAY_NS + SPAN_NS)
    of_night = rows_of_night("rejects", frames.rejects, night)
    sensors = judged_sensors(frames)
    futures = [
        judge_logs.submit(
            Batch(sensors[k : k + SENSORS_OF_TASK]), frames.cameras, of_night, between_ns,
            settings.sensors.state_gap_s,
        )
        for k in range(0, len(sensors), SENSORS_OF_TASK)
    ]  # fmt: skip
    checks = concat(CHECKS, results(Stage.READ, futures))
    for sentence in mistakes(checks.to_pylist()):
        LOGGER.warning("%s", sentence)
    return checks


def check_readings(work: Work, checks: pa.Table) -> pa.Table:
    """Return CHECKS with what the lines of sight of a night say of the sensors' states."""
    viewed = work.folder.viewed(work.round)
    judged = judge_readings.submit(viewed, list(work.spans), work.all_spans())
    (found,) = results(Stage.CHECK, [judged])
    for sentence in mistakes(found.to_pylist()):
        LOGGER.warning("%s", sentence)
    return concat(CHECKS, [checks, found])

"""The checks of a night's logs: what was written otherwise than it says."""

import logging
from collections.abc import Sequence

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.flows.night.calibrating import stars_of
from epipole.flows.night.doubt import Settled
from epipole.flows.night.progress import results
from epipole.flows.night.work import Work
from epipole.io.datasets.rows_by_night import rows_of_night
from epipole.io.work.parts import read_part
from epipole.schemas.bridge import array, concat, rows_with
from epipole.schemas.log_checks import CheckVerdict, LogCheck, mistakes
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS, SPAN_NS, day_of
from epipole.schemas.stages import Stage
from epipole.schemas.tables import CHECKS
from epipole.tasks.calibrate.judge_star_scatter import judge_star_scatter
from epipole.tasks.check.judge_doubt import doubt_table, fault_table, name_cut_times
from epipole.tasks.check.judge_readings import judge_readings
from epipole.tasks.common.batches import in_batches
from epipole.tasks.read.judge_logs import (
    NightFrames,
    absent_sensors,
    judge_logs,
    judged_sensors,
)
from epipole.tasks.read.order_frames import OrderedFrames

LOGGER = logging.getLogger(__name__)


def check_logs(
    frames: OrderedFrames, night: str, usual: Sequence[str], settings: Settings
) -> pa.Table:
    """Return CHECKS of the logs of a night, and of half an hour before and after it.

    `usual` are the sensors that nights before have frames of.
    """
    start_ns = day_of(night) * DAY_NS
    between_ns = (start_ns - SPAN_NS, start_ns + DAY_NS + SPAN_NS)
    of_night = rows_of_night("rejects", frames.rejects, night)
    sensors = judged_sensors(frames)
    n_frames = {
        name: sum(each.n_frames for each in spans)
        for name, spans in zip(frames.sensors, frames.spans, strict=True)
    }
    present = {
        name: [each for each in spans if each.span.start_ns // DAY_NS == day_of(night)]
        for name, spans in zip(frames.sensors, frames.spans, strict=True)
    }
    between = [
        (min(each.first_ns for each in spans), max(each.last_ns for each in spans))
        for spans in present.values() if spans
    ]  # fmt: skip
    extent = NightFrames.of_most(between, settings.sensors.max_gaps)
    expected = usual if settings.sensors.expected is None else settings.sensors.expected
    absent = absent_sensors(name for name in expected if not present.get(name))
    futures = [
        judge_logs.submit(
            batch, frames.cameras, of_night, between_ns, settings.sensors.state_gap_s, extent
        )
        for batch in in_batches(sensors, [n_frames.get(each.sensor_id, 0) for each in sensors])
    ]
    return _with_warnings(concat(CHECKS, [*results(Stage.READ, futures), absent]))


def wrong_velocities(checks: pa.Table) -> set[str]:
    """Return the sensors whose velocities contradict the path of their positions."""
    return {
        row["sensor_id"]
        for row in checks.select(["sensor_id", "check", "verdict"]).to_pylist()
        if row["check"] == LogCheck.VELOCITY and row["verdict"] == CheckVerdict.WRONG
    }


def check_star_scatter(work: Work, checks: pa.Table) -> pa.Table:
    """Return CHECKS with what the stars of a night say of the stated errors of centroids."""
    futures = [
        judge_star_scatter.submit(work.frames, batch)
        for batch in work.sensor_batches(stars_of(work, work.spans))
    ]
    found = concat(CHECKS, results(Stage.CALIBRATE, futures))
    is_sigma = pc.equal(checks["check"], LogCheck.CENTROID_SIGMA.value)
    judged = pc.and_(is_sigma, pc.is_in(checks["sensor_id"], found["sensor_id"].combine_chunks()))
    # Of a sensor whose errors are impossible, the warning was given.
    wrong = pc.and_(is_sigma, pc.equal(checks["verdict"], CheckVerdict.WRONG.value))
    warned = checks.filter(wrong)["sensor_id"].combine_chunks()
    _with_warnings(found.filter(pc.invert(pc.is_in(found["sensor_id"], warned))))
    return concat(CHECKS, [checks.filter(pc.invert(judged)), found])


def check_readings(settled: Settled, frames: OrderedFrames, checks: pa.Table) -> pa.Table:
    """Return CHECKS with what the lines of sight of a night say of the sensors' states."""
    work, doubt = settled.work, settled.doubt
    viewed = work.folder.viewed(work.round)
    checks = name_cut_times(checks, settled.clocks, doubt)
    faulty = {one.sensor_id for one in work.verdicts if one.is_faulty}
    judged = judge_readings.submit(
        viewed, list(work.spans), work.all_spans(), faulty, doubt is not None
    )
    (found,) = results(Stage.CHECK, [judged])
    added = settled.solved.added
    if doubt is not None:
        exposure_s = {each.sensor_id: _exposure_s(frames, each.number) for each in work.spans}
        found = concat(CHECKS, [found, doubt_table(doubt, added.km, exposure_s)])
    found = concat(CHECKS, [found, fault_table(work.verdicts, added)])
    return concat(CHECKS, [checks, _with_warnings(found)])


def _exposure_s(frames: OrderedFrames, sensor: int) -> float:
    """Return the median exposure time of a sensor's frames, 0 where it is unknown."""
    columns, name = ["sensor_id", "exposure_s"], frames.sensors[sensor]
    pieces = [
        rows_with(read_part(piece, "exposures", columns), "sensor_id", name)
        for piece in frames.pieces[sensor]
    ]
    return float(np.median(array(pa.concat_tables(pieces), "exposure_s")))


def _with_warnings(checks: pa.Table) -> pa.Table:
    """Return CHECKS after a warning for each mistake."""
    for sentence in mistakes(checks.to_pylist()):
        LOGGER.warning("%s", sentence)
    return checks

"""Judge times: whether they are UTC, as satellites of a catalogue show."""

import logging
from pathlib import Path

import pyarrow.compute as pc

from epipole.io.datasets.night_tables import read_columns, rewrite_table
from epipole.schemas.bridge import concat
from epipole.schemas.stages import Stage
from epipole.schemas.tables import CHECKS
from epipole.tasks.algorithms.known_objects.time_offset import TimeOffset, find_time_offset
from epipole.tasks.algorithms.log_checks.findings import (
    SOUND,
    UNKNOWN,
    UTC_TIMES,
    WRONG,
    Finding,
)
from epipole.tasks.algorithms.log_checks.frames import (
    GPS_S,
    HOUR_S,
    TAI_GPS_S,
    TAI_S,
    known_offset,
)
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.name.elements_of_night import ElementsOfNight
from epipole.tasks.name.known_objects import catalogue_of
from epipole.tasks.name.known_tracklets import sampled_tracklets
from epipole.tasks.read.judge_sensor import checks_table, sentence_of

LOGGER = logging.getLogger(__name__)

TRACKLETS = 100  # that are compared
# Time scales, and zones of local time.
IN_USE_S = [
    sign * offset
    for offset in (GPS_S, TAI_S, TAI_GPS_S, *(HOUR_S * k for k in range(1, 15)))
    for sign in (1, -1)
]
# Fewer known satellites than this, or a smaller share of the tracklets, tell nothing: at some
# wrong offsets, 4 of 186 tracklets passed for satellites.
MIN_KNOWN, MIN_SHARE = 5, 0.1
# Larger offsets are no error of the catalogue: of real elements that are a day old, the offset was
# 0.01 s in four scenes. Both have to be exceeded.
MIN_OFFSET_S, MIN_SIGMAS = 0.5, 5.0


@stage_task(Stage.NAME, "times")
def judge_times(folder: Path, known: ElementsOfNight) -> None:
    """Add rows to the `checks` of a night: how far its times are from UTC.

    Parameters
    ----------
    folder
        The night's folder; its `tracklets` and `checks` are written.
    """
    tracklets = sampled_tracklets(folder, TRACKLETS)
    checks = read_columns(folder, "checks", CHECKS.names)
    sensors = pc.unique(checks["sensor_id"]).to_pylist()
    if not (len(tracklets.time_ns) and known.sets and sensors):
        return
    offset = find_time_offset(tracklets, catalogue_of(known), IN_USE_S)
    found = finding_of(offset, len(tracklets.time_ns))
    if found.verdict == WRONG:
        LOGGER.warning("all sensors: %s", sentence_of(found))
    rows = checks_table({name: [found] for name in sensors})
    # A task that was killed as it wrote starts again: its rows are there once.
    others = checks.filter(pc.not_equal(checks["check"], UTC_TIMES))
    rewrite_table(folder, "checks", [concat(CHECKS, [others, rows])])


def finding_of(offset: TimeOffset, n_tracklets: int) -> Finding:
    """Return what an offset of the times says, found with `n_tracklets`."""
    value, sigma = offset.offset_s, offset.sigma_s
    facts: dict[str, float] = {
        "known": offset.n_known, "as_written": offset.n_as_written, "tracklets": n_tracklets,
    }  # fmt: skip
    if offset.n_known < max(MIN_KNOWN, MIN_SHARE * n_tracklets):
        return Finding(UTC_TIMES, UNKNOWN, cause="few_known_satellites", facts=facts)
    facts |= {"offset_s": known_offset(value), "within_s": abs(value) + 2 * sigma}
    found = Finding(UTC_TIMES, SOUND, value, sigma, 0.0, "s", facts=facts)
    if abs(value) > max(MIN_OFFSET_S, MIN_SIGMAS * sigma):
        return found._replace(verdict=WRONG, cause="times_not_utc")
    return found

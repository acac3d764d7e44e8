"""Judge doubt: what to say of sensors that disagree, be it clear or not who is wrong."""

from collections.abc import Iterable, Mapping

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.work_layout import AddedErrors
from epipole.schemas.bridge import concat
from epipole.schemas.tables import CHECKS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.log_checks.findings import (
    FRAME_TIMES,
    SENSOR_FAULT,
    SENSORS_AGREE,
    UNKNOWN,
    WRONG,
    Finding,
)
from epipole.tasks.algorithms.sensor_faults.fault_judgement import Doubt
from epipole.tasks.check.check_sensors import SPEED_KM_S, SensorVerdict
from epipole.tasks.read.judge_sensor import checks_table

SIGMAS = 4.0  # within which an offset is that of half the exposure
SHARP = 10.0  # sigmas of half an exposure: with fewer, any offset may look like it
SHARE = 0.05  # of half the exposure, which may be as much off: shutters are not instant
CUT_S = 1.0  # times are cut to whole seconds


def doubt_table(doubt: Doubt, more_km: float, exposure_s: Mapping[str, float]) -> pa.Table:
    """Return CHECKS of the sensors of a night in doubt.

    Parameters
    ----------
    more_km
        Error that the positions of all sensors were given, per axis.
    exposure_s
        Exposure time of each sensor's frames; 0 where it is unknown.
    """
    times_s = np.array(list(exposure_s.values()))
    found = Finding(
        SENSORS_AGREE, WRONG, more_km, expected=0.0, unit="km", cause="sensors_in_doubt"
    )
    if np.isfinite(doubt.shared_s):
        half_s = float(np.median(times_s)) / 2 if len(times_s) else 0.0
        facts = {
            "offset_s": doubt.shared_s, "sigma_s": doubt.shared_sigma_s, "exposure_s": 2 * half_s,
        }  # fmt: skip
        within_s = max(SIGMAS * doubt.shared_sigma_s, SHARE * half_s)
        alike = len(times_s) and np.ptp(times_s) <= SHARE * half_s
        is_sharp = half_s > SHARP * doubt.shared_sigma_s
        is_half = alike and is_sharp and abs(abs(doubt.shared_s) - half_s) < within_s
        cause = "exposure_start" if doubt.shared_s < 0 else "exposure_end"
        found = found._replace(cause=cause if is_half else "shared_offset", facts=facts)
    return checks_table({name: [found] for name in exposure_s})


def fault_table(verdicts: Iterable[SensorVerdict], added: AddedErrors) -> pa.Table:
    """Return CHECKS of the sensors at fault that take part, corrected or with larger errors."""
    with_errors = {fault.sensor_id for fault in added.faults}
    found = {}
    for one in verdicts:
        if not (one.sensor_id in with_errors or (one.corrected and one.is_faulty)):
            continue
        fault = added.of(one.sensor_id)
        size, sigma = one.size, one.size_sigma
        value, unit, cause = fault.left_km, "km", "ephemeris_off"
        if one.has_wrong_clock:
            size, sigma, cause = one.offset_s, one.sigma_s, "clock_off"
            value = SPEED_KM_S * sigma if one.corrected else value
        elif fault.rad:
            size, sigma, value = size / ARCSEC, sigma / ARCSEC, fault.left_rad / ARCSEC
            unit, cause = "arcsec", "attitude_off"
        facts = {"size": size, "size_sigma": sigma}
        found[one.sensor_id] = [
            Finding(SENSOR_FAULT, WRONG, value, expected=0.0, unit=unit, cause=cause, facts=facts)
        ]
    return checks_table(found)


def name_cut_times(
    checks: pa.Table, clocks: Iterable[SensorVerdict], shared: Doubt | None = None
) -> pa.Table:
    """Return CHECKS in which times that may be cut are so, where clocks are early.

    `clocks` are those that are wrong. If all share an offset too (`shared`), all are early by it.
    """
    may_be = pc.and_(pc.equal(checks["check"], FRAME_TIMES), pc.equal(checks["verdict"], UNKNOWN))
    names = {
        row["sensor_id"]
        for row in checks.filter(may_be).to_pylist()
        if row["cause"] == "whole_times" and row["value"] == CUT_S
    }
    # Rounded up, times would be late; cut, they are early by less than a second.
    offsets = [(one.sensor_id, one.offset_s, one.sigma_s) for one in clocks]
    if shared is not None and np.isfinite(shared.shared_s):
        offsets += [(name, shared.shared_s, shared.shared_sigma_s) for name in names]
    cut = {
        name
        for name, offset_s, sigma_s in offsets
        if name in names and -CUT_S - SIGMAS * sigma_s < offset_s < -SIGMAS * sigma_s
    }
    if not cut:
        return checks
    found = Finding(FRAME_TIMES, WRONG, CUT_S, expected=0.0, unit="s", cause="times_cut")
    replaced = pc.and_(may_be, pc.is_in(checks["sensor_id"], pa.array(sorted(cut))))
    kept = checks.filter(pc.invert(replaced))
    return concat(CHECKS, [kept, checks_table({name: [found] for name in cut})])

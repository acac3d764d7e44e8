"""Judge a sensor's log: units, frames, times and cameras, as they were written."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.schemas.arrays import Array, Integers
from epipole.schemas.bridge import array, concat, flatten, nullable, rows_with, stack, table
from epipole.schemas.log_checks import LogCause, LogCheck
from epipole.schemas.rejects import Reason, by_reason
from epipole.schemas.spans import ALL_TIME
from epipole.schemas.tables import CHECKS
from epipole.schemas.work_tables import EXPOSURES, ITRF, LOG_STATES, LogContents
from epipole.tasks.algorithms.constants import SECOND_NS
from epipole.tasks.algorithms.log_checks.findings import (
    LEFT_OUT_STATES,
    SOUND,
    WRONG,
    Finding,
)
from epipole.tasks.algorithms.log_checks.frames import (
    GPS_S,
    TAI_GPS_S,
    TAI_S,
    LogCamera,
    LogFrames,
    check_frames,
)
from epipole.tasks.algorithms.log_checks.states import LogStates, check_states

MAX_SAMPLED = 100  # frames of which centroids are looked at
SAME_TIME_NS = SECOND_NS  # calibrations of one time
MIN_LEFT_OUT = 0.5  # share of a sensor's states: damage is less, a wrong unit is all of them
LEFT_OUT = {
    Reason.BAD_VELOCITY: LogCause.VELOCITIES_TOO_FAST,
    Reason.BAD_POSITION: LogCause.POSITIONS_TOO_FAR,
    Reason.INSIDE_EARTH: LogCause.POSITIONS_TOO_NEAR,
    Reason.UNKNOWN_FRAME: LogCause.UNKNOWN_FRAME_NAME,
}
_SCALES = {
    0.0: "no time scale in use is that far from UTC",
    GPS_S: "GPS and UTC differ by 18 s",
    TAI_GPS_S: "TAI and GPS differ by 19 s",
    TAI_S: "TAI and UTC differ by 37 s",
}


RowsOf = tuple[pa.Table, Integers]  # a table, and the rows of it that are meant


class SensorLog(NamedTuple):
    """What the logs have of one sensor, in any order.

    `time_ns` and `number` (n,) are those of all frames, `sampled` EXPOSURES some of them. `states`
    are LOG_STATES, `cameras` CAMERAS. `left_out` counts states that were not read, by reason.
    """

    time_ns: Integers
    number: Integers
    sampled: pa.Table
    states: pa.Table
    cameras: pa.Table
    left_out: Mapping[str, int]


def sensor_log(
    sensor: str,
    exposures: Sequence[RowsOf],
    states: Sequence[RowsOf],
    cameras: pa.Table,
    rejects: pa.Table,
) -> SensorLog:
    """Return what EXPOSURES, LOG_STATES, CAMERAS and REJECTS have of one sensor.

    `exposures` and `states` are rows of this sensor, see `rows_by_sensor`.
    """
    time_ns, number = (
        np.concatenate([np.zeros(0, np.int64), *(array(of, name)[k] for of, k in exposures)])
        for name in ("time", "frame_number")
    )
    chosen = _sample(time_ns, number)
    bounds = np.cumsum([0, *(len(k) for _, k in exposures)])
    sampled = [
        of.take(k[chosen[(first <= chosen) & (chosen < end)] - first])
        for (of, k), (first, end) in zip(exposures, pairwise(bounds), strict=True)
    ]
    return SensorLog(
        time_ns,
        number,
        concat(EXPOSURES, sampled),
        concat(LOG_STATES, [of.take(k) for of, k in states]),
        rows_with(cameras, "sensor_id", sensor),
        by_reason(rows_with(rejects, "sensor_id", sensor)),
    )


def _sample(time_ns: Integers, number: Integers) -> Integers:
    """Return the rows of at most some `MAX_SAMPLED` frames, evenly chosen; each frame counts once,
    in whatever pieces it comes."""
    keys = np.stack([time_ns, number], axis=1)
    first = np.unique(keys, axis=0, return_index=True)[1] if len(keys) else np.zeros(0, np.int64)
    return np.sort(first[:: max(len(first) // MAX_SAMPLED, 1)])


def rows_by_sensor(rows: pa.Table, between_ns: tuple[int, int] = ALL_TIME) -> dict[str, Integers]:
    """Return the rows of each sensor between two times, in the order of the table: one pass."""
    time_ns = array(rows, "time")
    inside = np.flatnonzero((time_ns >= between_ns[0]) & (time_ns < between_ns[1]))
    ids = rows["sensor_id"].combine_chunks().dictionary_encode()
    code = np.asarray(ids.indices.to_numpy())[inside]
    order = np.argsort(code, kind="stable")
    bounds = np.searchsorted(code[order], np.arange(len(ids.dictionary) + 1))
    return {
        name: inside[order[first:end]]
        for name, (first, end) in zip(ids.dictionary.to_pylist(), pairwise(bounds), strict=True)
    }


def judge_sensor(log: SensorLog, state_gap_s: float) -> list[Finding]:
    """Return the findings of one sensor."""
    states, frames = _log_states(log.states), _log_frames(log)
    found = _left_out(log.left_out, log.states.num_rows)
    found += check_states(states)
    found += check_frames(frames, states.time_ns, _camera(log.cameras), state_gap_s)
    # A check that is made of states and of frames: what is wrong counts.
    by_check: dict[str, Finding] = {}
    for each in found:
        known = by_check.setdefault(each.check, each)
        if each.verdict == WRONG and known.verdict != WRONG:
            by_check[each.check] = each
    return list(by_check.values())


def judge_log(log: LogContents, state_gap_s: float) -> pa.Table:
    """Return CHECKS of all sensors of one log, those too of which nothing could be read."""
    exposures, states = rows_by_sensor(log.exposures), rows_by_sensor(log.states)
    names = {*exposures, *states, *log.rejects["sensor_id"].drop_null().to_pylist()} - {""}
    nothing = np.zeros(0, np.int64)
    return checks_table(
        {
            name: judge_sensor(
                sensor_log(
                    name, [(log.exposures, exposures.get(name, nothing))],
                    [(log.states, states.get(name, nothing))], log.cameras, log.rejects,
                ),
                state_gap_s,
            )
            for name in names
        }
    )  # fmt: skip


def _log_states(states: pa.Table) -> LogStates:
    """Return the states in order of time; of several frames, those in the most frequent one."""
    frames = pc.value_counts(states["frame"].combine_chunks()).to_pylist()
    frame = max(frames, key=lambda each: each["counts"])["values"] if frames else ""
    rows = rows_with(states, "frame", frame)
    order = np.argsort(array(rows, "time"), kind="stable")
    return LogStates(
        array(rows, "time")[order],
        stack(rows, "{}_km")[order],
        stack(rows, "v{}_km_s")[order],
        array(rows, "position_sigma_km")[order],
        frame == ITRF,
    )


def _log_frames(log: SensorLog) -> LogFrames:
    """Return the frames in order of time, each once."""
    keys = np.unique(np.stack([log.time_ns, log.number], axis=1), axis=0)
    once = np.diff(keys[:, 0], prepend=-1) > 0
    sigma_px = _known(log.sampled, "sigma_px")
    return LogFrames(
        keys[once, 0],
        keys[once, 1],
        keys[:, 1],
        flatten(log.sampled, "x_px")[0],
        flatten(log.sampled, "y_px")[0],
        _known(log.sampled, "flux"),
        sigma_px[sigma_px > 0],
        array(log.sampled, "exposure_s"),
    )


def _known(exposures: pa.Table, name: str) -> Array:
    """Return the values of a list column that are known."""
    return flatten(exposures.filter(pc.is_valid(exposures[name])), name)[0]


def _camera(cameras: pa.Table) -> LogCamera | None:
    if not cameras.num_rows:
        return None
    time_ns = array(cameras, "time")
    names = ("width", "height", "fx_px", "fy_px", "cx_px", "cy_px")
    values = np.stack([np.asarray(cameras[name].to_numpy(), float) for name in names], axis=1)
    first = int(np.argmin(time_ns))
    same = np.abs(time_ns - time_ns[first]) <= SAME_TIME_NS
    differ = (values != values[first]).any(axis=1)
    stated = dict(zip(names, values[first].tolist(), strict=True))
    # Frames after a change of the image size may fill the largest of its images.
    stated |= dict(zip(names[:2], values[:, :2].max(axis=0).tolist(), strict=True))
    return LogCamera(**stated, others=int((same & differ).sum()))


def _left_out(counts: Mapping[str, int], kept: int) -> list[Finding]:
    """Return whether the sensor's states are beyond the bounds, all or most of them."""
    of_states = {reason: counts.get(reason, 0) for reason in LEFT_OUT}
    total = kept + sum(of_states.values())
    if not total:
        return []
    reason, count = max(of_states.items(), key=lambda each: each[1])
    found = Finding(LEFT_OUT_STATES, SOUND, count / total, expected=0.0)
    if count < MIN_LEFT_OUT * total:
        return [found]
    facts = {"count": count, "states": total}
    return [found._replace(verdict=WRONG, cause=LEFT_OUT[reason].value, facts=facts)]


def checks_table(findings: Mapping[str, Iterable[Finding]]) -> pa.Table:
    """Return CHECKS of the findings of sensors, in the order of the checks."""
    order = list(LogCheck)
    rows = [
        (sensor, found)
        for sensor in sorted(findings)
        for found in sorted(findings[sensor], key=lambda each: order.index(LogCheck(each.check)))
    ]
    numbers = {
        name: nullable(np.array([getattr(found, name) for _, found in rows], float))
        for name in ("value", "sigma", "expected")
    }
    return table(
        CHECKS,
        {
            "sensor_id": [sensor for sensor, _ in rows],
            "check": [found.check for _, found in rows],
            "verdict": [found.verdict for _, found in rows],
            "cause": [found.cause or None for _, found in rows],
            **numbers,
            "unit": [found.unit or None for _, found in rows],
            "sentence": [sentence_of(found) for _, found in rows],
        },
    )


def sentence_of(found: Finding) -> str:
    """Return a finding as a sentence: the evidence, and the cure where there is one."""
    cause = LogCause(found.cause) if found.cause else None
    numbers = {
        **found._asdict(),
        **found.facts,
        "percent": 100 * found.value,
        "scale": _scale(found.facts.get("offset_s", 0.0)),
        **{f"gap_{end}": _clock(found.facts.get(f"{end}_s", 0.0)) for end in ("from", "to")},
    }
    if cause is None:
        return LogCheck(found.check).sound.format(**numbers)
    evidence = cause.evidence.format(**numbers)
    return f"{evidence}; {cause.cure}" if cause.cure else evidence


def _clock(time_s: float) -> str:
    return str(np.datetime64(int(time_s), "s"))[11:]


def _scale(offset_s: float) -> str:
    return _SCALES.get(abs(offset_s), f"clocks that differ by {abs(offset_s) / 3600:.0f} h")

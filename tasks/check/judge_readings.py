"""Judge readings: whether lines of sight meet as the states are written, or read otherwise."""

import math
from collections.abc import Collection, Iterator, Sequence

import numpy as np
import pyarrow as pa

from epipole.io.catalogues.earth_orientation import read_earth_orientation
from epipole.io.work.work_layout import ViewedParts
from epipole.schemas.arrays import Integers
from epipole.schemas.bridge import array, stack, stack_covariance
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import TEME, VIEWS
from epipole.tasks.algorithms.constants import SECOND_NS
from epipole.tasks.algorithms.log_checks.findings import (
    LINES_OF_SIGHT,
    SOUND,
    UNKNOWN,
    WRONG,
    Finding,
)
from epipole.tasks.algorithms.log_checks.meeting_lines import (
    NamedReading,
    Sights,
    StatedMeetings,
    judge_meetings,
)
from epipole.tasks.algorithms.orbits.reference_frames import orientation_at, to_gcrf
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.read.judge_sensor import checks_table

MAX_SPANS = 2  # that are looked at
# Epochs of a span are taken by two, so that also short tracklets are compared twice.
MAX_TWOS, TWO_NS = 8, 10 * SECOND_NS
MAX_PAIRS = 60_000  # of views, of a span
MAX_VIEWS = 250  # of an epoch: some sensors are left out where there are more
# Share of a sensor's tracklets that meet others as the states are written, without evidence of
# common objects: up to it there are none, with more its views are too vague to tell.
MIN_STATED_SHARE = 0.5
# Minimum share of a sensor's tracklets that meet others with a reading, where a fault explains
# them too. Where the reading is right it is 0.98 and more; an ephemeris 20 km off had 0.67 of its
# views by another.
MIN_SHARE_AT_FAULT = 0.9


@stage_task(Stage.CHECK, "readings")
def judge_readings(
    viewed: ViewedParts,
    sensors: Sequence[Sensor],
    spans: Sequence[Span],
    at_fault: Collection[str] = (),
    in_doubt: bool = False,
) -> pa.Table:
    """Return CHECKS of the sensors whose views can be compared with others at the same time.

    `at_fault` are the sensors of which lines of sight show a fault, of whatever cause; `in_doubt`
    says that it is not clear which sensor has one.
    """
    step = max(len(spans) // MAX_SPANS, 1)
    tables = [rows for span in spans[::step] for rows in _sampled(viewed, sensors, span)]
    if not tables:
        return checks_table({})
    rows = pa.concat_tables(tables)
    names = sorted(set(rows["sensor_id"].to_pylist()))
    sights = _sights(rows, names)
    stated, readings = judge_meetings(sights, _gcrf_from_teme(int(array(rows, "epoch")[0])))
    found = {name: [_as_stated(stated, k)] for k, name in enumerate(names)}
    for reading in readings:
        finding = _finding(reading)
        numbers = {reading.sensor, reading.other} - {-1} or set(range(len(names)))
        concerned = {names[k] for k in numbers}
        # A fault of one sensor explains views of all that do not meet.
        is_explained = not concerned.isdisjoint(at_fault) and not (
            concerned <= set(at_fault) and reading.share >= MIN_SHARE_AT_FAULT
        )
        is_one = reading.sensor >= 0 and reading.other < 0
        if not (is_explained or (is_one and in_doubt)):
            found |= {name: [finding] for name in concerned}
    return checks_table(found)


def _sampled(viewed: ViewedParts, sensors: Sequence[Sensor], span: Span) -> Iterator[pa.Table]:
    """Yield VIEWS of some epochs at which at least two sensors have views."""
    columns = {
        number: array(viewed[number].read(span, "views", ["epoch"]), "epoch")
        for number in (sensor.number for sensor in sensors)
        if viewed[number].holds(span)
    }
    every = [np.unique(epoch_ns, return_counts=True) for epoch_ns in columns.values()]
    if len(every) < 2:
        return
    epochs, at = np.unique(np.concatenate([e for e, _ in every]), return_inverse=True)
    n_views = np.bincount(at, np.concatenate([n for _, n in every]))
    shared = np.bincount(at) >= 2
    if not shared.any():
        return
    fewer = math.ceil(n_views[shared].max() / MAX_VIEWS)
    best = _sampled_epochs(epochs[shared], n_views[shared].mean() / fewer)
    for number in list(columns)[::fewer]:
        rows = np.flatnonzero(np.isin(columns[number], best))
        if len(rows):
            yield viewed[number].read(span, "views", VIEWS.names).take(rows)


def _sampled_epochs(epoch_ns: Integers, n_views: float) -> Integers:
    """Return some of the epochs, by two, with not too many pairs of views at all of them."""
    n_twos = int(np.clip(MAX_PAIRS // (n_views**2 + 1), 1, MAX_TWOS))
    first = np.linspace(0, len(epoch_ns) - 1, min(n_twos, len(epoch_ns))).astype(int)
    second = np.searchsorted(epoch_ns, epoch_ns[first] + TWO_NS).clip(0, len(epoch_ns) - 1)
    return np.asarray(epoch_ns[np.union1d(first, second)])


def _sights(rows: pa.Table, names: Sequence[str]) -> Sights:
    number = {name: k for k, name in enumerate(names)}
    epoch_ns = array(rows, "epoch")
    tracklets = list(zip(*(rows[c].to_pylist() for c in ("sensor_id", "tracklet_id")), strict=True))
    numbered = {each: k for k, each in enumerate(dict.fromkeys(tracklets))}
    cov = sum(
        stack_covariance(rows, f"cov_{kind}_{{}}_rad2", TANGENT_AXES) for kind in ("noise", "bias")
    )
    v_km_s = stack(rows, "sensor_v{}_km_s")
    return Sights(
        (epoch_ns - epoch_ns.min()) / SECOND_NS,
        np.array([number[sensor_id] for sensor_id, _ in tracklets], np.int64),
        np.array([numbered[each] for each in tracklets], np.int64),
        stack(rows, "u{}"),
        np.sqrt(np.trace(cov, axis1=1, axis2=2) / 2),
        stack(rows, "{}_km"),
        np.where(np.isfinite(v_km_s), v_km_s, 0.0),
        array(rows, "position_sigma_km"),
    )


def _gcrf_from_teme(time_ns: int) -> np.ndarray:
    at = np.full(3, time_ns)
    orientation = orientation_at(at, *read_earth_orientation())
    return to_gcrf(TEME, at, np.eye(3), np.zeros((3, 3)), orientation)[0].T


def _as_stated(stated: StatedMeetings, sensor: int) -> Finding:
    share, by_accident = float(stated.share[sensor]), float(stated.by_accident[sensor])
    found = Finding(LINES_OF_SIGHT, SOUND, share, expected=1.0)
    if stated.is_sound[sensor]:
        return found
    if share <= MIN_STATED_SHARE:
        return found._replace(verdict=UNKNOWN, cause="no_common_objects")
    facts = {"share_percent": 100 * by_accident}
    return found._replace(verdict=UNKNOWN, cause="views_too_vague", facts=facts)


def _finding(reading: NamedReading) -> Finding:
    odds = min(reading.log_odds / np.log(10.0), 99.0)
    facts = {
        "share_percent": 100 * reading.share, "odds": odds, "offset_s": reading.offset_s,
    }  # fmt: skip
    return Finding(
        LINES_OF_SIGHT, WRONG, reading.stated_share, expected=1.0, cause=reading.cause, facts=facts
    )

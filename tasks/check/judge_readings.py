"""Judge readings: whether lines of sight meet as the states are written, or read otherwise."""

from collections.abc import Collection, Iterator, Sequence

import numpy as np
import pyarrow as pa

from epipole.io.catalogues.earth_orientation import read_earth_orientation
from epipole.io.work.work_layout import ViewedParts
from epipole.schemas.bridge import array, stack, stack_covariance
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import TEME, VIEWS
from epipole.tasks.algorithms.log_checks.findings import (
    LINES_OF_SIGHT,
    SOUND,
    UNKNOWN,
    WRONG,
    Finding,
)
from epipole.tasks.algorithms.log_checks.meeting_lines import (
    MIN_BETTER,
    MIN_STATED_SHARE,
    NamedReading,
    Sights,
    find_reading,
    shares_that_meet,
)
from epipole.tasks.algorithms.orbits.reference_frames import orientation_at, to_gcrf
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.read.judge_sensor import checks_table

MAX_SPANS = 2  # that are looked at
MAX_EPOCHS = 4  # of a span
MAX_VIEWS = 100  # of an epoch: pairs are compared
# Minimum share of a sensor's views that meet others with a reading, where a fault explains them
# too. Where the reading is right it is 0.98 and more; an ephemeris 20 km off had 0.67 by another.
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
    share, by_accident = shares_that_meet(sights)
    found = {
        name: [_as_stated(float(share[k]), float(by_accident[k]))] for k, name in enumerate(names)
    }
    for reading in find_reading(sights, _gcrf_from_teme(int(array(rows, "epoch")[0]))):
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
    n_sensors = np.bincount(at)
    usable = epochs[(n_sensors >= 2) & (n_views <= MAX_VIEWS)]
    if not len(usable):
        return
    best = usable[np.linspace(0, len(usable) - 1, min(MAX_EPOCHS, len(usable))).astype(int)]
    for number, epoch_ns in columns.items():
        rows = np.flatnonzero(np.isin(epoch_ns, best))
        if len(rows):
            yield viewed[number].read(span, "views", VIEWS.names).take(rows)


def _sights(rows: pa.Table, names: Sequence[str]) -> Sights:
    number = {name: k for k, name in enumerate(names)}
    cov = sum(
        stack_covariance(rows, f"cov_{kind}_{{}}_rad2", TANGENT_AXES) for kind in ("noise", "bias")
    )
    v_km_s = stack(rows, "sensor_v{}_km_s")
    return Sights(
        np.unique(array(rows, "epoch"), return_inverse=True)[1].astype(np.int64),
        np.array([number[name] for name in rows["sensor_id"].to_pylist()], np.int64),
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


def _as_stated(share: float, by_accident: float) -> Finding:
    found = Finding(LINES_OF_SIGHT, SOUND, share, expected=1.0)
    if not share > MIN_STATED_SHARE:
        return found._replace(verdict=UNKNOWN, cause="no_common_objects")
    if share - by_accident <= MIN_BETTER:
        facts = {"share_percent": 100 * by_accident}
        return found._replace(verdict=UNKNOWN, cause="views_too_vague", facts=facts)
    return found


def _finding(reading: NamedReading) -> Finding:
    odds = min(reading.log_odds / np.log(10.0), 99.0)
    facts = {
        "share_percent": 100 * reading.share, "odds": odds, "offset_s": reading.offset_s,
    }  # fmt: skip
    return Finding(
        LINES_OF_SIGHT, WRONG, reading.stated_share, expected=1.0, cause=reading.cause, facts=facts
    )

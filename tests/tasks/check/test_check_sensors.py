"""Check of sensors: what was corrected and what remains; nothing from nothing."""

import numpy as np
import polars as pl
import pytest
from scenes.associations import filled
from scenes.late_sensors import POSITION_KM, SIGMA, lines_of

from epipole.io.work.parts import SOLVED, write_part
from epipole.io.work.work_layout import SolvedParts, ViewedParts
from epipole.schemas.bridge import empty, to_polars, unstack
from epipole.schemas.spans import SPAN_NS, Sensor, Span
from epipole.schemas.tables import POSITIONS
from epipole.schemas.work_tables import CLOCK_LINES, VIEWS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.check.check_sensors import (
    JudgedSights,
    SensorVerdict,
    add_corrections,
    add_faults,
    check_sensors,
    sensor_verdicts,
)
from epipole.tasks.solve.positions import solve_positions
from epipole.tasks.solve.sample_sight_lines import LineSampling, moving_objects, sample_sight_lines
from epipole.tasks.solve.view_groups import unpack_views

PER_OBJECT = 3 * ARCSEC  # error of the optics
LATE = SensorVerdict("a", 0.25, 0.01, "clock")
EARLY = SensorVerdict("b", -0.5, 0.01, "clock")
SOUND = SensorVerdict("c", 0.01, 0.01)


def test_an_offset_is_the_correction_and_what_remains_of_it():
    remaining = [SensorVerdict("a", 0.001, 0.008), SOUND]
    total = add_corrections([LATE, EARLY], remaining)
    assert [clock.sensor_id for clock in total] == ["a", "b", "c"]
    assert total[0] == SensorVerdict("a", 0.251, 0.008, "clock", corrected=True)
    assert total[1:] == [EARLY._replace(corrected=True), SOUND]


def test_faults_of_logs_are_those_taken_off_and_what_is_left():
    before = [SensorVerdict("a", 0.0, 0.1, "ephemeris", 5.0, 0.3, (3.0, 4.0, 0.0), 0.2), SOUND]
    now = [
        SensorVerdict("a", 0.0, 0.1),
        SOUND._replace(cause="ephemeris", size=1.0, bias=(1.0, 0.0, 0.0)),
    ]
    assert add_faults(before, now) == [before[0], now[1]]
    again = SensorVerdict("a", 0.0, 0.1, "ephemeris", 1.0, 0.1, (0.0, 0.0, 12.0), 0.1)
    (total,) = add_faults(before[:1], [again])
    assert (total.size, total.bias) == (13.0, (3.0, 4.0, 12.0))
    assert add_faults([LATE], [LATE._replace(offset_s=0.3)]) == [LATE]  # it was not corrected
    (other,) = add_faults(before[:1], [again._replace(cause="attitude")])
    assert (other.cause, other.fault()) == ("disagrees", None)


def test_without_views_no_clock_is_known():
    objects = moving_objects(empty(POSITIONS), 13_000_000_000)
    views = unpack_views(empty(VIEWS), np.zeros(0, np.int64))
    groups = solve_positions(views, reject_sigma=5.0)
    lines = sample_sight_lines(groups, objects, LineSampling(1))
    assert lines.equals(empty(CLOCK_LINES))
    assert sensor_verdicts(to_polars(lines)) == JudgedSights([])
    assert sensor_verdicts(to_polars(lines), {"a": 0.5}) == JudgedSights([])


def rows_of(lines, attitude_rad2, noise=SIGMA, turn_noise=0.0, fitted_s=0):
    """Return CLOCK_LINES of nine objects, each in a part of the fields of its own, at epochs every
    2 s, each fitted to detections within `fitted_s` of it."""
    n = len(lines.group)
    epoch, number = 2_000_000_000 * (lines.group % 60), lines.group // 60
    columns = {
        "first_fitted": epoch - 1_000_000_000 * fitted_s,
        "last_fitted": epoch + 1_000_000_000 * fitted_s,
        "tracklet_id": [f"t{k}" for k in number], "turn_noise_rad2": np.full(n, turn_noise**2),
        "epoch": epoch, "sensor_id": [f"s{s}" for s in lines.sensor], "field_part": number,
        "object_id": [f"o{k}" for k in number], "position_sigma_km": np.full(n, POSITION_KM),
        "attitude_rad2": np.full(n, attitude_rad2),
    }  # fmt: skip
    for name, cov in (("noise", noise**2 + turn_noise**2), ("bias", PER_OBJECT**2)):
        columns |= {f"cov_{name}_{a}{a}_rad2": np.full(n, cov) for a in "12"}
    for pattern, values in (
        ("u{}", lines.u), ("{}_km", lines.x_km), ("v{}_km_s", lines.v_km_s),
        ("sensor_{}_km", lines.r_km), ("sensor_v{}_km_s", lines.v_sensor_km_s),
    ):  # fmt: skip
        columns |= unstack(pattern, values)
    return to_polars(filled(CLOCK_LINES, n, columns))


def test_errors_of_optics_that_differ_over_the_field_are_no_faults_of_sensors():
    lines = lines_of(1, np.zeros(4))
    off = np.random.default_rng(1).normal(size=(4, 9, 3)) * PER_OBJECT
    u = lines.u + off[lines.sensor, lines.group // 60]
    lines = lines._replace(u=u / np.linalg.norm(u, axis=1)[:, None])
    judged = sensor_verdicts(rows_of(lines, 0.0))
    assert not any(one.is_faulty for one in judged.verdicts)
    assert not judged.doubt.undecided
    assert judged.doubt.spread_log_odds < 3.0
    # As turns of the sensors the same errors contradict each other.
    alike = sensor_verdicts(rows_of(lines, PER_OBJECT**2))
    faulty = any(one.is_faulty for one in alike.verdicts)
    assert faulty or alike.doubt.undecided or alike.doubt.spread_log_odds > 6.0


@pytest.mark.parametrize(("n_objects", "faulty"), [(1, []), (2, ["s3"])])
def test_a_sensor_with_a_single_shared_object_is_not_judged(n_objects, faulty):
    """All its lines are off alike by 5 sigmas of one."""
    lines = lines_of(1, np.zeros(4))
    kept = (lines.sensor != 3) | (lines.group < 60 * n_objects)
    lines = lines._replace(**{name: getattr(lines, name)[kept] for name in lines._fields})
    u = lines.u + np.where(lines.sensor == 3, 5 * SIGMA, 0.0)[:, None] * [0.0, 0.0, 1.0]
    lines = lines._replace(u=u / np.linalg.norm(u, axis=1)[:, None])
    rows = rows_of(lines, 0.0).with_columns(cov_bias_11_rad2=0.0, cov_bias_22_rad2=0.0)
    # In another span an object has the same number.
    late = pl.col("epoch") > rows["epoch"].median()
    span = pl.when(late).then(pl.lit("1/")).otherwise(pl.lit("0/"))
    rows = rows.with_columns(object_id=span + pl.col("object_id"))
    judged = sensor_verdicts(rows)
    assert [one.sensor_id for one in judged.verdicts if one.is_faulty] == faulty
    assert [one.sensor_id for one in judged.verdicts][:3] == ["s0", "s1", "s2"]
    assert not judged.doubt.undecided
    assert judged.doubt.spread_log_odds < 3.0


def test_a_sensor_that_shares_objects_only_with_such_ones_is_not_judged():
    lines = lines_of(1, np.zeros(4))
    number = lines.group // 60
    # Sensor 0 sees two objects, each with one other sensor, which sees no more.
    kept = np.where(lines.sensor == 0, number < 2, number == lines.sensor - 1)
    lines = lines._replace(**{name: getattr(lines, name)[kept] for name in lines._fields})
    assert sensor_verdicts(rows_of(lines, 0.0)) == JudgedSights([])


def offsets_in_sigmas(seed, noise, turn_noise):
    """Return the offsets found for sound sensors, in their sigmas.

    Lines are fitted to the detections of three epochs, of `noise` each, and all lines of a sensor
    at an epoch are turned alike.
    """
    rng = np.random.default_rng(seed)
    lines = lines_of(seed, np.zeros(4))
    number, epoch = lines.group // 60, lines.group % 60
    of_detection = rng.normal(size=(4, 9, 62, 3)) * noise * np.sqrt(3)
    of_line = (of_detection[:, :, :-2] + of_detection[:, :, 1:-1] + of_detection[:, :, 2:]) / 3
    turn = rng.normal(size=(4, 62, 3)) * turn_noise * np.sqrt(3)
    turn = (turn[:, :-2] + turn[:, 1:-1] + turn[:, 2:]) / 3
    u = lines.u + of_line[lines.sensor, number, epoch]
    u += np.cross(turn[lines.sensor, epoch], lines.u)
    lines = lines._replace(u=u / np.linalg.norm(u, axis=1)[:, None])
    rows = rows_of(lines, 0.0, np.hypot(noise, SIGMA), turn_noise, 2)
    judged = sensor_verdicts(rows.with_columns(cov_bias_11_rad2=0.0, cov_bias_22_rad2=0.0))
    assert not any(one.is_faulty for one in judged.verdicts)
    assert judged.doubt.spread_log_odds < 3.0
    return [one.offset_s / one.sigma_s for one in judged.verdicts]


@pytest.mark.parametrize(("noise", "turn_noise"), [(6.0, 0.0), (3.0, 3.0)])
def test_what_lines_of_the_same_frames_share_is_not_counted_as_independent(noise, turn_noise):
    found = [offsets_in_sigmas(k, noise * SIGMA, turn_noise * SIGMA) for k in range(20)]
    assert 0.8 < np.sqrt(np.mean(np.square(found))) < 1.2


def test_without_objects_no_clock_is_known(tmp_path):
    solved, spans = SolvedParts(tmp_path), [Span(k * SPAN_NS, (k + 1) * SPAN_NS) for k in (7, 8)]
    sensors = ViewedParts(tmp_path / "views"), [Sensor(0, "a")]
    assert check_sensors.fn(solved, *sensors, spans) == JudgedSights([])
    tables = {name: empty(schema) for name, schema in SOLVED.items()}
    write_part(solved.piece(spans[1], 0), SOLVED, tables)
    assert check_sensors.fn(solved, *sensors, spans) == JudgedSights([])

"""Assumptions of the settings undo the mistakes of a log."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from epipole.io.logs.messages.encoding import StateMessage
from epipole.io.logs.reader import read_log_pieces
from epipole.io.logs.writer import LogWriter
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.bridge import array
from epipole.schemas.errors import SettingsError
from epipole.schemas.given_settings import with_assumptions
from epipole.schemas.settings import Assumption, Settings
from epipole.tasks.read.assume_readings import (
    VELOCITIES,
    as_assumed,
    as_assumed_source,
    in_kilometres,
    without_velocities,
)
from epipole.tasks.read.order_frames import frame_times, order_logs
from epipole.tasks.read.read_logs import read_log_into

EXAMPLE = Path(__file__).parents[3] / "examples" / "four_sensor_geo.mcap"
SENSORS = ("sat1", "sat2", "sat3", "sat4")
START_NS = 1_554_091_200_000_000_000


@pytest.fixture(scope="module")
def piece():
    (only,) = read_log_pieces(EXAMPLE)
    return only


def ahead(rows, by_s, sensors):
    """The rows with later times of some sensors."""
    of = np.isin(array(rows, "sensor_id"), sensors)
    time = pa.array(array(rows, "time") + np.where(of, round(by_s * 1e9), 0))
    index = rows.schema.get_field_index("time")
    return rows.set_column(index, rows.schema.field("time"), time.cast(rows.schema.types[index]))


def later(piece, by_s, *sensors):
    tables = (ahead(getattr(piece, n), by_s, sensors) for n in ("exposures", "states", "cameras"))
    moved = (None if t is None else t + round(by_s * 1e9) for t in piece.source[-2:])
    ends = dict(zip(piece.source._fields[-2:], moved, strict=True))
    return piece._replace(
        **dict(zip(("exposures", "states", "cameras"), tables, strict=True)),
        source=piece.source._replace(**ends),
    )


def times_of(piece):
    """The times of the frames and of the states of a piece."""
    return [array(piece.exposures, "time")], [array(piece.states, "time")]


@pytest.mark.parametrize(
    ("by_s", "assumed"),
    [
        (18.0, {"time": "gps"}),
        (37.0, {"time": "tai"}),
        (3618.0, {"time": "gps", "ahead_s": 3600.0}),
        (-0.5, {"ahead_s": -0.5}),
    ],
)
def test_times_of_all_sensors_are_taken_back(piece, by_s, assumed):
    wrong, assumptions = later(piece, by_s, *SENSORS), [Assumption(**assumed)]
    found = as_assumed(wrong, assumptions)
    source = as_assumed_source(wrong.source, *times_of(found), assumptions)
    assert found._replace(source=source) == piece


@pytest.mark.parametrize(("scale", "before_s"), [("gps", 17), ("tai", 36)])
def test_times_about_a_leap_second_are_taken_back(scale, before_s, tmp_path):
    # The last second of 2016 was a leap second: GPS-UTC went from 17 s to 18 s.
    midnight_ns = int(np.datetime64("2017-01-01", "ns").astype(np.int64))
    utc_s = np.array([-40, -20, -2, -1, 0, 1, 20, 40])
    written_s = utc_s + np.where(utc_s < 0, before_s, before_s + 1)
    with LogWriter(tmp_path / "a.mcap") as log:
        for k, at_s in enumerate(written_s.tolist()):
            time_ns = midnight_ns + at_s * 1_000_000_000
            log.frame("s", time_ns, frame_number=k, exposure_s=0.1, x_px=[], y_px=[])
    (read,) = read_log_pieces(tmp_path / "a.mcap")
    found = as_assumed(read, [Assumption(time=scale)])
    assert ((array(found.exposures, "time") - midnight_ns) / 1e9).tolist() == utc_s.tolist()
    local = [Assumption(time=scale, ahead_s=-7200.0)]
    found = as_assumed(later(read, -7200.0, "s"), local)
    assert ((array(found.exposures, "time") - midnight_ns) / 1e9).tolist() == utc_s.tolist()


def test_times_of_one_sensor_are_taken_back_and_no_frame_is_outside_the_log(piece):
    wrong = later(piece, 18.0, "sat2")
    gps = [Assumption(sensor="sat2", time="gps")]
    found = as_assumed(wrong, gps)
    assert (found.exposures, found.states) == (piece.exposures, piece.states)
    time_ns = array(found.exposures, "time")
    source = as_assumed_source(wrong.source, *times_of(found), gps)
    assert source.first_time_ns <= time_ns.min() <= time_ns.max() <= source.last_time_ns


def test_frames_of_reference_and_velocities_are_those_assumed(piece):
    assumed = [
        Assumption(sensor="sat1", states="TEME"), Assumption(sensor="sat1", velocities="unknown"),
    ]  # fmt: skip
    states = as_assumed(piece, assumed).states
    mine = array(states, "sensor_id") == "sat1"
    assert set(array(states, "frame")[mine]) == {"TEME"}
    for name in VELOCITIES:
        assert np.isnan(states[name].to_numpy()[mine]).all()
        np.testing.assert_array_equal(
            states[name].to_numpy()[~mine], piece.states[name].to_numpy()[~mine]
        )
    assert states.filter(pa.array(~mine)) == piece.states.filter(pa.array(~mine))


def test_times_of_frames_alone_are_taken_back(piece):
    late = piece._replace(exposures=ahead(piece.exposures, 18.0, SENSORS))
    assert as_assumed(late, [Assumption(frames_ahead_s=18.0)]) == piece


@pytest.mark.parametrize(("instant", "earlier_by"), [("start", 0.5), ("end", -0.5)])
def test_the_middle_of_exposures_is_found_from_their_ends(piece, instant, earlier_by):
    rows = piece.exposures
    exposure_s = np.linspace(0.1, 1.0, rows.num_rows)
    index = rows.schema.get_field_index("exposure_s")
    rows = rows.set_column(index, rows.schema.field("exposure_s"), pa.array(exposure_s))
    written = array(rows, "time") - np.round(earlier_by * exposure_s * 1e9).astype(np.int64)
    index, field = rows.schema.get_field_index("time"), rows.schema.field("time")
    at_ends = rows.set_column(index, field, pa.array(written).cast(field.type))
    found = as_assumed(piece._replace(exposures=at_ends), [Assumption(frame_time=instant)])
    assert np.abs(array(found.exposures, "time") - array(rows, "time")).max() <= 1


@pytest.mark.parametrize("instant", ["start", "end"])
def test_no_frame_is_a_stray_because_its_exposure_is_long(instant, tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        for k, exposure_s in enumerate([4.0, 1.0, 4.0]):
            time_ns = START_NS + k * 1_000_000_000
            log.frame("s", time_ns, frame_number=k, exposure_s=exposure_s, x_px=[], y_px=[])
    folder, assumed = ReadFolder(tmp_path), [Assumption(frame_time=instant)]
    read = read_log_into(folder, 0, str(tmp_path / "a.mcap"), assumed)
    frames = order_logs(folder, [read], Settings().sensors)
    assert frames.rejects.num_rows == 0
    time_ns = frame_times(folder, 0)
    assert len(time_ns) == 3
    ends = read.source.first_time_ns, read.source.last_time_ns
    assert ends == (time_ns[0], time_ns[-1])


def metres(state, *sensors):
    """The state as a log in metres has it, of some sensors."""
    if state.sensor_id not in sensors:
        return state
    return state._replace(
        position_km=np.asarray(state.position_km) * 1e3,
        velocity_km_s=np.asarray(state.velocity_km_s) * 1e3,
        position_sigma_km=state.position_sigma_km * 1e3,
    )


def test_units_are_read_before_bounds_are_checked(piece):
    # Metres a second are faster than any velocity may be: all states of sat1 would be left out.
    units = {"position_unit": "m", "position_sigma_unit": "m", "velocity_unit": "m/s"}
    assumed = in_kilometres([Assumption(sensor="sat1", **units)])
    (wrong,) = read_log_pieces(EXAMPLE, as_meant=lambda state: metres(state, "sat1"))
    (right,) = read_log_pieces(EXAMPLE, as_meant=lambda state: assumed(metres(state, "sat1")))
    assert "sat1" not in set(wrong.states["sensor_id"].to_pylist())
    assert right.states.num_rows == piece.states.num_rows
    for name in ("x_km", "vz_km_s", "position_sigma_km"):
        np.testing.assert_allclose(array(right.states, name), array(piece.states, name), rtol=1e-14)
    assert right.rejects == piece.rejects


def test_units_are_those_of_the_sensor_that_is_named():
    state = StateMessage(0, "sat2", "GCRF", (7e6, 0.0, 0.0), (), 50.0, (), 0.0)
    one, every = Assumption(sensor="sat1", position_unit="m"), Assumption(position_unit="m")
    assert in_kilometres([one])(state) is state
    assert in_kilometres([every])(state).position_km.tolist() == [7000.0, 0.0, 0.0]
    assert in_kilometres([every])(state).position_sigma_km == 50.0
    sigma = Assumption(position_sigma_unit="m")
    assert in_kilometres([every, sigma])(state).position_sigma_km == 0.05
    assert in_kilometres([Assumption(time="gps")]) is None


def test_what_nobody_assumes_stays(piece):
    assert as_assumed(piece, [Assumption(sensor="sat9", time="gps", states="ITRF")]) == piece
    assert as_assumed(piece, ()) is piece
    gps = [Assumption(sensor="sat9", time="gps")]
    assert as_assumed_source(piece.source, *times_of(piece), gps) == piece.source
    assert as_assumed_source(piece.source, [], [], ()) is piece.source


def test_assumptions_of_a_command_join_those_of_the_settings():
    written = with_assumptions(Settings(), ["*.time=gps"])
    both = with_assumptions(written, ["sat1.states=TEME", "sat1.ahead_s=0.5"])
    assert both.sensors.assume == (
        Assumption(time="gps"), Assumption(sensor="sat1", states="TEME", ahead_s=0.5),
    )  # fmt: skip
    assert both.key() != written.key()


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("sat1=gps", "not SENSOR.NAME=VALUE"),
        ("sat1.time", "not SENSOR.NAME=VALUE"),
        ("sat1.time=ut1", "assume.0.time = 'ut1'"),
        ("sat1.scale=gps", "sensors.assume.0.scale"),
    ],
)
def test_an_assumption_that_means_nothing_is_refused(text, says):
    with pytest.raises(SettingsError, match=says):
        with_assumptions(Settings(), [text])


def test_states_without_velocities_keep_everything_else(piece):
    states = without_velocities(piece.states)
    assert all(states[name].null_count == states.num_rows for name in VELOCITIES)
    assert states.drop_columns(list(VELOCITIES)).equals(piece.states.drop_columns(list(VELOCITIES)))

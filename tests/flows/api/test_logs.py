"""Logs as tables, in and out."""

import datetime
import re

import polars as pl
import pytest
from mcap.reader import make_reader
from polars.testing import assert_frame_equal

from epipole.flows import api
from epipole.io.logs.writer import LogWriter
from epipole.schemas.errors import LogError, LogWarning
from epipole.tasks.algorithms.orbits.reference_frames import EME2000_FROM_GCRF

TIME = datetime.datetime(2019, 4, 1, 4, tzinfo=datetime.UTC)
CAMERA = {"width": 512, "height": 512, "fx_px": 1e3, "fy_px": 1e3, "cx_px": 255.5, "cy_px": 255.5}


def tables(**changes):
    """Return frames, states and cameras with the fewest columns; `changes` are of the frames."""
    key = {"sensor_id": ["a"], "time": [TIME]}
    frames = {"frame_number": [7], "x_px": [[1.0, 2.0]], "y_px": [[3.0, 4.0]]}
    return (
        pl.DataFrame(key | frames | changes),
        pl.DataFrame(key | {"x_km": [7000.0], "y_km": [0.0], "z_km": [0.0]}),
        pl.DataFrame(key | {name: [value] for name, value in CAMERA.items()}),
    )


def test_a_log_comes_back_as_it_was_written(night_log, tmp_path):
    log = api.read_log(night_log)
    for encoding in ("protobuf", "json", "ros2"):
        copy = tmp_path / f"{encoding}.mcap"
        api.write_log(copy, log.frames, log.states, log.cameras, encoding=encoding)
        again = api.read_log(copy)
        assert again.frames.equals(log.frames.sort("time", "sensor_id"))
        # A quaternion that is normalised again differs in its last digit.
        assert_frame_equal(again.states, log.states.sort("time", "sensor_id"), abs_tol=1e-15)
        assert again.cameras.equals(log.cameras.sort("time", "sensor_id"))
        assert again.rejects.height == 0


def test_messages_are_written_in_order_of_time(night_log, tmp_path):
    log = api.read_log(night_log)
    api.write_log(tmp_path / "a.mcap", log.frames.reverse(), log.states, log.cameras)
    with (tmp_path / "a.mcap").open("rb") as file:
        times = [m.log_time for *_, m in make_reader(file).iter_messages(log_time_order=False)]
    assert times == sorted(times)


def test_columns_that_are_left_out_are_unknown(tmp_path):
    api.write_log(tmp_path / "a.mcap", *tables())
    frames, states, cameras, rejects = api.read_log(tmp_path / "a.mcap")
    assert frames["flux"].to_list() == frames["sigma_px"].to_list() == [None]
    assert frames["frame_number"].to_list() == [7]
    assert states.select("vx_km_s", "qw").row(0) == (None, None)
    assert states["position_sigma_km"].to_list() == [0.0]
    assert cameras["k1"].to_list() == [0.0]
    assert rejects.height == 0


@pytest.mark.parametrize("values", [[None, None], [2.0, None]])
def test_sigmas_of_states_that_are_null_are_unknown(tmp_path, values):
    frames, states, cameras = tables()
    states = pl.concat([states, states.with_columns(pl.col("time") + datetime.timedelta(0, 1))])
    sigmas = [pl.Series(n, values) for n in ("position_sigma_km", "attitude_sigma_arcsec")]
    api.write_log(tmp_path / "a.mcap", frames, states.with_columns(sigmas), cameras)
    read = api.read_log(tmp_path / "a.mcap").states
    for sigma in sigmas:
        assert read[sigma.name].to_list() == [value or 0.0 for value in values]


@pytest.mark.parametrize("sensor_id", ["cam.1", "", "_a", "a" * 64, "caf\u00e9"])
@pytest.mark.parametrize("number", [0, 1, 2])
def test_sensor_ids_that_a_reader_refuses_are_not_written(tmp_path, sensor_id, number):
    made = list(tables())
    made[number] = made[number].with_columns(sensor_id=pl.lit(sensor_id))
    name = ("frames", "states", "cameras")[number]
    message = f"table {name}: sensor_id '{sensor_id}': expected 1 to 63 letters of A-Z"
    with pytest.raises(ValueError, match=re.escape(message)):
        api.write_log(tmp_path / "a.mcap", *made)
    assert not list(tmp_path.iterdir())


def test_sensor_ids_that_a_reader_takes_are_written(tmp_path):
    for name in ("a" * 63, "1-_B", "Z"):
        made = [rows.with_columns(sensor_id=pl.lit(name)) for rows in tables()]
        api.write_log(tmp_path / "a.mcap", *made)
        log = api.read_log(tmp_path / "a.mcap")
        assert log.frames["sensor_id"].to_list() == [name]
        assert log.rejects.height == 0


def test_states_are_in_gcrf_whatever_the_frame_of_the_log(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        log.state("a", 1_554_091_200_000_000_000, position_km=[7e3, 1e3, 0], frame="EME2000")
    states = api.read_log(tmp_path / "a.mcap").states
    expected = EME2000_FROM_GCRF.T @ [7e3, 1e3, 0]
    assert states.select("x_km", "y_km", "z_km").row(0) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"y_px": [[3.0]]}, "x_px and y_px differ in length in frame 7 of a: 2 and 1"),
        ({"flux": [[1.0, 2.0, 3.0]]}, "x_px and flux differ in length"),
        ({"brightness": [1.0]}, r"unknown columns \['brightness'\]"),
        ({"time": ["noon"]}, "column time is not timestamp"),
        ({"frame_number": [None]}, "column frame_number"),
        ({"frame_number": [-1]}, "table frames: frame_number of a is -1, expected 0 or later"),
        ({"time": [TIME.replace(year=1960)]}, "time of a is 1960-.* expected 1970 or later"),
    ],
)
def test_wrong_tables_are_named(tmp_path, change, message):
    with pytest.raises(ValueError, match=message):
        api.write_log(tmp_path / "a.mcap", *tables(**change))
    assert not list(tmp_path.iterdir())


def test_tables_may_be_lazy_or_arrow_or_columns_by_name(tmp_path):
    frames, states, cameras = tables()
    api.write_log(tmp_path / "a.mcap", frames, states, cameras)
    api.write_log(tmp_path / "b.mcap", frames.lazy(), states.to_arrow(), cameras.to_dict())
    first, second = (api.read_log(tmp_path / f"{name}.mcap") for name in "ab")
    assert all(one.equals(other) for one, other in zip(first[:3], second[:3], strict=True))
    with pytest.raises(TypeError, match="table states: is a list, expected a polars DataFrame"):
        api.write_log(tmp_path / "c.mcap", frames, [1], cameras)
    with pytest.raises(ValueError, match="table states: cannot be made of these columns"):
        api.write_log(tmp_path / "c.mcap", frames, {"time": [1, 2], "x_km": [1]}, cameras)


@pytest.mark.parametrize(
    ("names", "absent"),
    [(("vx_km_s", "vy_km_s", "vz_km_s"), "vy_km_s"), (("qx", "qy", "qz", "qw"), "qw")],
)
def test_a_vector_with_a_part_of_its_components_is_refused(tmp_path, names, absent):
    frames, states, cameras = tables()
    states = states.with_columns(pl.lit(0.5).alias(name) for name in names)
    states = states.with_columns(pl.lit(None, pl.Float64).alias(absent))
    with pytest.raises(ValueError, match=f"table states: {absent} of a is null in 1 rows"):
        api.write_log(tmp_path / "a.mcap", frames, states, cameras)


@pytest.mark.parametrize(
    ("lens", "term"),
    [({"k4": [0.1]}, "k4"), ({"fisheye": [True], "p1": [0.1]}, "p1"),
     ({"fisheye": [True], "p2": [-0.1], "k1": [0.2]}, "p2")],
)  # fmt: skip
def test_a_distortion_that_a_log_cannot_hold_is_refused(tmp_path, lens, term):
    frames, states, cameras = tables()
    cameras = cameras.with_columns(**{name: pl.Series(value) for name, value in lens.items()})
    with pytest.raises(ValueError, match=f"table cameras: {term} of a is"):
        api.write_log(tmp_path / "a.mcap", frames, states, cameras)
    assert not list(tmp_path.iterdir())


def test_missing_columns_are_named(tmp_path):
    frames, states, cameras = tables()
    with pytest.raises(ValueError, match=r"table frames: missing columns \['x_px'\]"):
        api.write_log(tmp_path / "a.mcap", frames.drop("x_px"), states, cameras)


def test_a_sound_log_is_written_without_a_warning(night_log, tmp_path, recwarn):
    log = api.read_log(night_log)
    api.write_log(tmp_path / "a.mcap", log.frames, log.states, log.cameras)
    assert not recwarn.list


def test_a_mistake_in_what_is_written_is_a_warning(night_log, tmp_path):
    log = api.read_log(night_log)
    in_m = [pl.col(name) * 1000 for name in ("x_km", "y_km", "z_km")]
    with pytest.warns(LogWarning, match=r"a\.mcap: .*: positions are in metres"):
        api.write_log(tmp_path / "a.mcap", log.frames, log.states.with_columns(in_m), log.cameras)
    assert api.read_log(tmp_path / "a.mcap").states.height == log.states.height


def test_what_a_reader_leaves_out_is_a_warning(tmp_path):
    made = tables(exposure_s=[9999.0])
    with pytest.warns(LogWarning, match=r"rejects of a reader: 1 bad_exposure: The frame's"):
        api.write_log(tmp_path / "a.mcap", *made)


def test_a_file_that_is_no_log_is_named(tmp_path):
    with pytest.raises(LogError, match="missing"):
        api.read_log(tmp_path / "missing.mcap")

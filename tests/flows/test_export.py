"""Export: what a night's tables say, as messages; all files or none, errors for people."""

import ccsds_ndm as ccsds
import numpy as np
import polars as pl
import pytest

from epipole.flows.export import export
from epipole.schemas.errors import DatasetError
from epipole.schemas.options import Message

NIGHT = "2019-04-01"

# EME2000 from GCRF as a small rotation: IERS Conventions (2010), equation 5.21 and after.
FRAME_BIAS = np.radians(np.array([6.8192, -16.617, -14.6]) / 3.6e6)


def directions(ra_deg, dec_deg):
    ra, dec = np.radians(ra_deg), np.radians(dec_deg)
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)


def observed(dataset, table="observations"):
    return pl.read_parquet(dataset / f"night={NIGHT}/{table}/*.parquet")


def test_tracking_data_are_the_observations_and_their_sensors_places(night_dataset, tmp_path):
    files = export(Message.tdm, str(night_dataset), NIGHT, tmp_path / "out")
    rows = observed(night_dataset).drop_nulls("object_id")
    objects, sensors = sorted(set(rows["object_id"])), sorted(set(rows["sensor_id"]))
    assert files == sorted([*(f"{o}.tdm" for o in objects), *(f"{s}.oem" for s in sensors)])
    message = ccsds.Tdm.from_file(str(tmp_path / "out" / f"{objects[0]}.tdm"))
    own = rows.filter(pl.col("object_id") == objects[0]).sort("sensor_id", "time")
    rows = [o for s in message.segments for o in s.data.observations]
    ra, dec = (np.array([o.value for o in rows if o.keyword == f"ANGLE_{k}"]) for k in "12")
    gcrf = directions(own["ra_deg"].to_numpy(), own["dec_deg"].to_numpy())
    off = directions(ra, dec) - (gcrf - np.cross(FRAME_BIAS, gcrf))
    assert np.abs(off).max() < 1e-10
    states = ccsds.Oem.from_file(str(tmp_path / "out" / f"{sensors[0]}.oem")).segments[0].data
    first = own.filter(pl.col("sensor_id") == sensors[0]).row(0, named=True)
    epoch = first["time"].strftime("%Y-%m-%dT%H:%M:%S")
    near = [v.x for v in states.state_vector if v.epoch.startswith(epoch)]
    assert np.isclose(near, first["x_km"], rtol=0, atol=1e-6).any()


def test_states_are_messages_of_their_own_and_ephemerides_of_their_arcs(night_dataset, tmp_path):
    states = observed(night_dataset, "states")
    opm = export(Message.opm, str(night_dataset), NIGHT, tmp_path / "opm")
    oem = export(Message.oem, str(night_dataset), NIGHT, tmp_path / "oem")
    assert len(opm) == len(states)
    assert len(oem) == states["object_id"].n_unique()
    state = ccsds.Opm.from_file(str(tmp_path / "opm" / opm[0])).segment.data.state_vector
    row = states.sort("object_id", "epoch").row(0, named=True)
    assert [state.x, state.z_dot] == pytest.approx([row["x_km"], row["vz_km_s"]], abs=1e-9)


def test_one_object_can_be_asked_for(night_dataset, tmp_path):
    name = observed(night_dataset)["object_id"].drop_nulls()[0]
    files = export(Message.tdm, str(night_dataset), NIGHT, tmp_path / "a", [name])
    assert [f for f in files if f.endswith("tdm")] == [f"{name}.tdm"]


def an_object_that_is_not_there(out):
    return {"object_ids": ["20190401-99999"]}, "no observations of 20190401-99999"


def another_night(out):
    return {"night": "2019-04-02"}, "has no night 2019-04-02"


def a_folder_with_files(out):
    out.mkdir()
    (out / "notes.txt").touch()
    return {}, "is not empty"


def a_file(out):
    out.touch()
    return {}, "is a file"


@pytest.mark.parametrize(
    "prepare", [an_object_that_is_not_there, another_night, a_folder_with_files, a_file]
)
def test_bad_input_is_one_line_and_nothing_is_written(prepare, night_dataset, tmp_path):
    asked, says = prepare(tmp_path / "out")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DatasetError, match=says):
        export(
            **{"kind": Message.tdm, "dataset": str(night_dataset), "night": NIGHT,
               "out": tmp_path / "out"} | asked
        )  # fmt: skip
    assert sorted(tmp_path.rglob("*")) == before

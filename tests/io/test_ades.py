"""ADES: valid by the IAU's own schema, the observations to the last digit, whatever the names."""

import subprocess
import sys

import numpy as np
import polars as pl
import pytest
from ades import adesutility
from scenes.made_nights import filled

from epipole.io.ades import catalogue_name, observation_file
from epipole.io.ccsds import Subject
from epipole.schemas.bridge import to_polars

HOSTILE = ['a|b\n"<&>', "\u4e2d\U0001f680", "s" * 400]
SIGMAS = {
    "sigma_ra_arcsec": [0.0, 2.5, 12345.678], "sigma_dec_arcsec": [3.25, 1e-9, 0.5],
    "correlation": [1.0, -0.25, 0.0],
}  # fmt: skip


@pytest.fixture(scope="module")
def schema():
    master = adesutility.readXML(adesutility.adesmaster)
    general = adesutility.readXML(adesutility.schemaxslts["general"])
    return adesutility.XMLtoSchemaViaXSLT(master, general)


def read_back(text, folder, schema) -> list[dict[str, str]]:
    """Return the fields of each observation; the file must fit the schema."""
    (folder / "a.psv").write_text(text)
    # In a process of its own: it can convert one file only.
    command = [sys.executable, "-m", "ades.psvtoxml", "a.psv", "a.xml"]
    ended = subprocess.run(command, cwd=folder, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout + ended.stderr
    tree = adesutility.readXML(str(folder / "a.xml"))
    assert schema.validate(tree), schema.error_log
    return [{field.tag: field.text for field in each} for each in tree.getroot()]


def observations(**columns) -> pl.DataFrame:
    base = {
        "object_id": ["o", None, None], "tracklet_id": HOSTILE, "sensor_id": HOSTILE,
        "ra_deg": [359.9999999999, 0.0, 123.456789012], "dec_deg": [-90.0, 1e-9, 45.0],
        "x_km": [-7000.0, 42164.123456, 5e5], "position_sigma_km": [0.01, 0.0, 3.0],
        "vx_km_s": [None, -7.5, 0.1], "vy_km_s": [None, 1e-9, 0.0], "vz_km_s": [None, 0.0, 0.0],
        "magnitude": [None, 6.5, 99.0], "magnitude_sigma": [None, 0.0, 0.1], **SIGMAS,
    }  # fmt: skip
    return to_polars(filled("observations", **base | columns))


def test_all_values_are_there_and_fit_the_schema(tmp_path, schema):
    names = {"o": Subject("o", 25544, "1998-067A", "ISS"), HOSTILE[1]: Subject("x", 7, None, "X")}
    rows = observations()
    found = read_back(observation_file(rows, names, "Hip2"), tmp_path, schema)
    assert [each.get("artSat") for each in found] == ["1998-067A", "NORAD 7", None]
    assert len({each["trkSub"] for each in found}) == 3
    assert [each["ra"] for each in found] == ["0.000000000", "0.000000000", "123.456789012"]
    for field, column in (("dec", "dec_deg"), ("pos1", "x_km"), ("pos2", "y_km")):
        told = [float(each[field]) for each in found]
        assert told == pytest.approx(rows[column].to_list(), abs=1e-5)
    assert [each.get("vel1") for each in found] == [None, "-7.5000000", "0.1000000"]
    assert [float(each["rmsRA"]) for each in found] == pytest.approx(
        [1e-4, 2.5, 12345.678], abs=0.7
    )
    assert [float(each["rmsCorr"]) for each in found] == [0.9999, -0.25, 0.0]
    assert [float(each["posCov22"]) for each in found] == [1e-4, 0.0, 9.0]
    assert [each.get("mag") for each in found] == [None, "6.50", None]
    assert all(len(each["remarks"]) <= 300 for each in found)


def test_a_damaged_designator_moves_no_columns(tmp_path, schema):
    names = {
        "o": Subject("o", 25544, "1998-067|A\n", "ISS")
    }  # as checksums of elements let through
    found = read_back(observation_file(observations(), names, "Hip2"), tmp_path, schema)
    assert [each.get("artSat") for each in found] == ["1998-067/A\\n", None, None]
    assert found[0]["obsTime"].endswith("Z")


def test_times_are_those_of_the_rows_to_the_microsecond(tmp_path, schema):
    rows = observations()
    found = read_back(observation_file(rows, {}, "UNK"), tmp_path, schema)
    told = np.array([each["obsTime"].rstrip("Z") for each in found], "datetime64[ns]")
    off = told.astype(np.int64) - rows["time"].dt.epoch("ns").to_numpy()
    assert np.abs(off).max() <= 500


def test_a_remark_names_a_tracklet_only_where_there_is_one(tmp_path, schema):
    rows = observations(object_id=["o"] * 3, tracklet_id=["t", None, "t"], sensor_id=["s"] * 3)
    found = [
        each["remarks"] for each in read_back(observation_file(rows, {}, "UNK"), tmp_path, schema)
    ]
    assert found[0].startswith("object o, sensor s, tracklet t, frame ")
    assert found[1].startswith("object o, sensor s, frame ")


def test_no_observation_is_a_file_without_rows():
    text = observation_file(observations().clear(), {}, "Hip2")
    assert text.splitlines()[0] == "# version=2022"
    assert len(text.splitlines()) == 2


def test_the_catalogue_has_the_name_that_ades_has_for_it():
    assert [catalogue_name(ids) for ids in ("HIP", "Gaia DR3", "", "x")] == [
        "Hip2", "Gaia3", "UNK", "UNK"
    ]  # fmt: skip

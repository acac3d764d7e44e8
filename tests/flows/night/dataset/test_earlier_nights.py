"""Earlier nights: staged ones first, then those of the dataset; a damaged one is left aside."""

import logging

import numpy as np
from scenes.associations import filled

from epipole.flows.night.dataset.earlier_nights import EarlierNights
from epipole.io.datasets.night_files import PART, write_table
from epipole.schemas.settings import KnownObjectSettings, Settings
from epipole.schemas.tables import ASSOCIATIONS, STATES

NIGHT = "2019-04-03"
START_NS = int(np.datetime64(NIGHT, "ns").astype(np.int64))
SETTINGS = Settings()


def write(folder, night, hours, names):
    """States and associations of objects so many hours before `NIGHT`."""
    epochs = [START_NS - round(each * 3600e9) for each in hours]
    rows = {"epoch": epochs, "object_id": names}
    for table, schema in (("states", STATES), ("associations", ASSOCIATIONS)):
        write_table(folder / f"night={night}", table, [filled(schema, len(epochs), rows)])
    return folder / f"night={night}"


def ids(rows):
    return rows["object_id"].to_pylist()


def test_the_end_of_the_night_before_is_read(tmp_path):
    write(tmp_path, "2019-04-02", [5.0, 0.4, 0.1], ["x", "y", "z"])
    write(tmp_path, "2019-04-01", [24.1], ["w"])
    nights = EarlierNights(str(tmp_path), {})
    assert ids(nights.last_views(NIGHT)) == ["y", "z"]
    assert ids(nights.last_states(NIGHT, SETTINGS)) == ["w", "x", "y", "z"]


def test_only_as_many_hours_are_read_as_are_asked_for(tmp_path):
    write(tmp_path, "2019-04-02", [5.0, 0.4], ["x", "y"])
    short = Settings(known_objects=KnownObjectSettings(earlier_h=1.0))
    none = Settings(known_objects=KnownObjectSettings(earlier_h=0.0))
    nights = EarlierNights(str(tmp_path), {})
    assert ids(nights.last_states(NIGHT, short)) == ["y"]
    assert ids(nights.last_states(NIGHT, none)) == []


def test_a_night_of_this_run_counts_more_than_that_of_the_dataset(tmp_path):
    write(tmp_path / "out", "2019-04-02", [0.1], ["old"])
    new = write(tmp_path / "staging", "2019-04-02", [0.1], ["new"])
    nights = EarlierNights(str(tmp_path / "out"), {"2019-04-02": new})
    assert ids(nights.last_views(NIGHT)) == ["new"]
    assert ids(nights.last_states(NIGHT, SETTINGS)) == ["new"]


def test_without_earlier_nights_there_are_no_rows(tmp_path):
    nights = EarlierNights(str(tmp_path / "none"), {})
    assert nights.last_views(NIGHT).num_rows == 0
    assert nights.last_states(NIGHT, SETTINGS).num_rows == 0


def test_a_damaged_night_is_left_aside_with_a_line(tmp_path, caplog):
    folder = write(tmp_path, "2019-04-02", [0.1], ["x"])
    for table in ("states", "associations"):
        (folder / table / PART).write_bytes(b"no parquet")
    nights = EarlierNights(str(tmp_path), {})
    with caplog.at_level(logging.WARNING, "epipole"):
        assert nights.last_views(NIGHT).num_rows == 0
        assert nights.last_states(NIGHT, SETTINGS).num_rows == 0
    assert "not recognised from the night 2019-04-02" in caplog.text

"""Earlier nights: staged ones first, then those of the dataset; a damaged one is left aside."""

import logging
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scenes.associations import filled

from epipole.flows.night.recorded_nights import EarlierNights
from epipole.io.datasets.night_tables import PART, write_table
from epipole.schemas.settings import KnownObjectSettings, Settings
from epipole.schemas.tables import ASSOCIATIONS, FRAMES, NIGHTS, STATES, TABLES

NIGHT = "2019-04-03"
START_NS = int(np.datetime64(NIGHT, "ns").astype(np.int64))
SETTINGS = Settings()


def write(folder, night, hours, names):
    """States and associations of objects so many hours before `NIGHT`."""
    epochs = [START_NS - round(each * 3600e9) for each in hours]
    rows = {"epoch": epochs, "object_id": names}
    seen = {"centroid": list(range(len(epochs))), "used": [True] * len(epochs)}
    for table, schema, more in (("states", STATES, {}), ("associations", ASSOCIATIONS, seen)):
        write_table(folder / f"night={night}", table, [filled(schema, len(epochs), rows | more)])
    return folder / f"night={night}"


def ids(rows):
    return rows["object_id"].to_pylist()


def test_the_end_of_the_night_before_is_read(tmp_path):
    write(tmp_path, "2019-04-02", [5.0, 0.4, 0.1], ["x", "y", "z"])
    write(tmp_path, "2019-04-01", [24.1], ["w"])
    nights = EarlierNights(str(tmp_path), {})
    assert ids(nights.last_views(NIGHT).detections) == ["y", "z"]
    assert ids(nights.last_objects(NIGHT, SETTINGS).states) == ["w", "x", "y", "z"]


def test_only_as_many_hours_are_read_as_are_asked_for(tmp_path):
    write(tmp_path, "2019-04-02", [5.0, 0.4], ["x", "y"])
    short = Settings(known_objects=KnownObjectSettings(earlier_h=1.0))
    none = Settings(known_objects=KnownObjectSettings(earlier_h=0.0))
    nights = EarlierNights(str(tmp_path), {})
    assert ids(nights.last_objects(NIGHT, short).states) == ["y"]
    assert ids(nights.last_objects(NIGHT, none).states) == []


def test_a_night_of_this_run_counts_more_than_that_of_the_dataset(tmp_path):
    write(tmp_path / "out", "2019-04-02", [0.1], ["old"])
    new = write(tmp_path / "staging", "2019-04-02", [0.1], ["new"])
    nights = EarlierNights(str(tmp_path / "out"), {"2019-04-02": new})
    assert ids(nights.last_views(NIGHT).detections) == ["new"]
    assert ids(nights.last_objects(NIGHT, SETTINGS).states) == ["new"]


def test_of_each_sensor_the_last_frame_before_midnight_is_read(tmp_path):
    folder = write(tmp_path, "2019-04-02", [0.1], ["x"])
    seconds, names = [2000.0, 9.0, 4.0, 3.0], ["c", "a", "b", "a"]
    times = [START_NS - round(each * 1e9) for each in seconds]
    frames = {"time": times, "sensor_id": names, "frame_number": [7, 40, 5, 46]}
    write_table(folder, "frames", [filled(FRAMES, len(times), frames)])
    last = EarlierNights(str(tmp_path), {}).last_views(NIGHT).frames.to_pylist()
    found = {row["sensor_id"]: row["frame_number"] for row in last}
    assert found == {"a": 46, "b": 5}  # the frame of c is older than half an hour


def test_without_earlier_nights_there_are_no_rows(tmp_path):
    nights = EarlierNights(str(tmp_path / "none"), {})
    assert nights.last_views(NIGHT).detections.num_rows == 0
    assert nights.last_objects(NIGHT, SETTINGS).states.num_rows == 0


def test_a_damaged_night_is_left_aside_with_a_line(tmp_path, caplog):
    folder = write(tmp_path, "2019-04-02", [0.1], ["x"])
    for table in ("states", "associations"):
        (folder / table / PART).write_bytes(b"no parquet")
    nights = EarlierNights(str(tmp_path), {})
    with caplog.at_level(logging.WARNING, "epipole"):
        assert nights.last_views(NIGHT).detections.num_rows == 0
        assert nights.last_objects(NIGHT, SETTINGS).states.num_rows == 0
    assert "not recognised from the night 2019-04-02" in caplog.text


def as_text(rows):
    """Return the rows with their first time as text that is no time."""
    times = pa.array(["noon"] * rows.num_rows)
    return rows.set_column(0, "epoch", times)


def without_a_column(rows):
    return rows.drop_columns(["object_id"])


def of_invalid_text(rows):
    """Return the rows with ids that are not UTF-8."""
    ids = pa.array([b"\xff\xfe"] * rows.num_rows, pa.binary())
    text = pa.Array.from_buffers(pa.string(), len(ids), ids.buffers())
    return rows.set_column(rows.schema.get_field_index("object_id"), "object_id", text)


def of_long_texts(rows):
    """Return the rows many times, with one id of a megabyte: 20 kB that unpack to 5 GB."""
    ids = pa.DictionaryArray.from_arrays(np.zeros(5000, np.int32), ["x" * 1_000_000])
    many = rows.take(np.zeros(5000, np.int64))
    return many.set_column(rows.schema.get_field_index("object_id"), "object_id", ids)


@pytest.mark.parametrize(
    "altered", [as_text, without_a_column, of_invalid_text, of_long_texts], ids=lambda f: f.__name__
)
def test_a_night_of_another_program_has_one_line_and_the_run_goes_on(tmp_path, altered, caplog):
    write(tmp_path, "2019-04-01", [30.0], ["w"])
    folder = write(tmp_path, "2019-04-02", [0.1], ["x"])
    for table in ("states", "associations"):
        path = folder / table / PART
        pq.write_table(altered(pq.read_table(path, partitioning=None)), path)
    nights = EarlierNights(str(tmp_path), {})
    with caplog.at_level(logging.WARNING, "epipole"):
        assert nights.last_views(NIGHT).detections.num_rows == 0
        assert ids(nights.last_objects(NIGHT, SETTINGS).states) == ["w"]
    (line,) = caplog.messages
    assert "2019-04-02" in line
    assert "\n" not in line


def test_states_that_are_no_numbers_are_left_aside(tmp_path):
    folder = write(tmp_path, "2019-04-02", [0.3, 0.2, 0.1], ["x", "y", "z"])
    path = folder / "states" / PART
    rows = pq.read_table(path, partitioning=None)
    for name, values in (("x_km", [np.nan, 1.0, 1.0]), ("cov_xx", [1.0, np.inf, 1.0])):
        rows = rows.set_column(rows.schema.get_field_index(name), name, pa.array(values))
    pq.write_table(rows, path)
    assert ids(EarlierNights(str(tmp_path), {}).last_objects(NIGHT, SETTINGS).states) == ["z"]


# Reads what a run reads of earlier nights, and prints how much it found.
READ = """
import sys
from epipole.flows.night.recorded_nights import EarlierNights
from epipole.schemas.settings import Settings
nights = EarlierNights(sys.argv[1], {})
key = nights.key("2019-04-03", Settings())
views = nights.last_views("2019-04-03").detections
states = nights.last_objects("2019-04-03", Settings()).states
# Not ru_maxrss: a child begins with its parent's.
peak_mb = int(open("/proc/self/status").read().split("VmHWM:")[1].split()[0]) // 1000
print(views.num_rows, states.num_rows, peak_mb)
"""
MAX_MB = 700  # 300 of it are the libraries'
EQUAL_ROWS = 3_000_000


@pytest.mark.parametrize(
    ("tables", "most"),
    [(["nights"], 0), (["states", "associations"], 60)],  # a row for each piece
    ids=["nights", "states"],
)
def test_millions_of_equal_rows_take_no_more_memory_than_one_piece(tmp_path, tables, most):
    folder = write(tmp_path, "2019-04-02", [0.1], ["x"])
    write_table(folder, "nights", [filled(NIGHTS, 1, {})])
    for table in tables:
        path = folder / table / PART
        piece = pq.read_table(path, partitioning=None).take(np.zeros(EQUAL_ROWS // 30, np.int64))
        with pq.ParquetWriter(path, TABLES[table]) as file:
            for _ in range(30):
                file.write_table(piece)
        assert path.stat().st_size < 2_000_000
    run = subprocess.run(
        [sys.executable, "-c", READ, str(tmp_path)], capture_output=True, text=True
    )
    *counts, peak_mb = run.stdout.split()
    assert all((most > 0) <= int(count) <= most for count in counts), run.stderr
    assert run.stderr.count("\n") == ("nights" in tables)  # a line that names the night
    assert int(peak_mb) < MAX_MB

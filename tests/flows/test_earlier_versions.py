"""Nights of an earlier version, which lack the columns that were added since, beside new ones."""

import shutil

import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from epipole.flows import api
from epipole.flows.evaluate import evaluate
from epipole.flows.export import Message, export
from epipole.flows.night.recorded_nights import EarlierNights, published_nights
from epipole.flows.overlay import overlay
from epipole.flows.report import report
from epipole.io.datasets.dataset import read_table
from epipole.schemas.columns import values_before
from epipole.schemas.errors import DatasetError
from epipole.schemas.settings import Settings
from epipole.schemas.tables import TABLES

OLD, NEW, AFTER = "2019-04-01", "2019-04-02", "2019-04-03"
# The tables that got columns: all that earlier nights may lack, but these.
WITHOUT = {
    "positions": {}, "tracklets": {"link_chi2"}, "observations": {"object_id", "magnitude"},
    "identifications": {"object_id"}, "calibrations": {}, "nights": {"known_key"},
}  # fmt: skip


def altered(dataset, table, change):
    """Write a table of the old night again."""
    path = dataset / f"night={OLD}" / table / "part-0.parquet"
    pq.write_table(change(pq.read_table(path, partitioning=None)), path)


def as_was(table):
    """Return a function that takes from rows what was added to their table since."""
    added = values_before(TABLES[table]).keys() - WITHOUT[table]
    return lambda rows: rows.drop_columns(list(added))


@pytest.fixture(scope="module")
def mixed(night_dataset, tmp_path_factory):
    dataset = tmp_path_factory.mktemp("mixed") / "out"
    for night in (OLD, NEW):
        shutil.copytree(night_dataset / f"night={OLD}", dataset / f"night={night}")
    for table in WITHOUT:
        altered(dataset, table, as_was(table))
    return dataset


def test_both_are_read_at_once_in_a_folder_and_in_a_store(mixed):
    there, url = (api.open_dataset(where) for where in (mixed, f"file://{mixed}"))
    for table in TABLES:
        rows = there[table].collect()
        assert rows.equals(url[table].collect()), table
        assert rows["night"].n_unique() == (2 if len(rows) else 0), table
    assert there["calibrations"].select(pl.col("k4", "fisheye").null_count()).collect().row(0) == (
        0, 0,
    )  # fmt: skip
    ranges = there["observations"].group_by("night").agg(pl.col("range_km").count()).collect()
    assert sorted(ranges["range_km"])[0] == 0 < sorted(ranges["range_km"])[1]


def test_one_added_column_alone_is_read(mixed):
    rows = read_table(mixed, "calibrations", OLD, ["fisheye"])
    assert rows["fisheye"].to_pylist() == [False] * 4


def test_they_are_not_stale_for_that_and_do_not_say_which_sensors_are_usual(mixed):
    assert published_nights(str(mixed), Settings(), None)[0].stale == []
    assert EarlierNights(str(mixed), {}).usual_sensors(NEW) == []
    assert len(EarlierNights(str(mixed), {}).usual_sensors(AFTER)) == 4


def test_what_is_made_of_them_is_made(mixed, night_dataset, night_log, tmp_path):
    found, expected = (evaluate(out, night_log).as_dict() for out in (mixed, night_dataset))
    of_added = {"passages_joined", *(name for name in expected if name.startswith("magnitude"))}
    assert {name for name in expected if found[name] != expected[name]} <= of_added
    assert report(str(mixed), OLD, tmp_path / "night.html")
    assert report(str(mixed), None, tmp_path / "nights.html")
    for kind in (Message.tdm, Message.opm):
        assert export(kind, str(mixed), OLD, tmp_path / kind)
    assert overlay(str(mixed), [str(night_log)], tmp_path / "over.mcap").nights == [OLD]


def as_text(rows):
    return rows.set_column(rows.schema.get_field_index("cx_px"), "cx_px", rows["sensor_id"])


def without_it(rows):
    return rows.drop_columns("cx_px")


def of_other_width(rows):
    narrow = rows["cx_px"].cast(pa.float32())
    return rows.set_column(rows.schema.get_field_index("cx_px"), "cx_px", narrow)


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (as_text, "its column cx_px has text, not numbers"),
        (without_it, "it has no column cx_px"),
    ],
)
def test_a_column_of_another_type_or_none_is_an_error_that_says_what_to_do(
    mixed, tmp_path, change, says
):
    shutil.copytree(mixed, tmp_path / "out")
    altered(tmp_path / "out", "calibrations", change)
    wanted = rf"night={OLD}/calibrations: cannot be read \({says}\); remove the folder of the night"
    for read in (
        lambda out: read_table(out, "calibrations", OLD),
        lambda out: report(str(out), OLD, tmp_path / "night.html"),
    ):
        with pytest.raises(DatasetError, match=wanted):
            read(tmp_path / "out")


def test_how_wide_a_number_is_stored_is_no_matter(mixed, tmp_path):
    shutil.copytree(mixed, tmp_path / "out")
    altered(tmp_path / "out", "calibrations", of_other_width)
    assert read_table(tmp_path / "out", "calibrations", OLD).schema.field("cx_px").type == "double"

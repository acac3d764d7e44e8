"""Datasets as polars tables."""

import datetime
import shutil

import polars as pl
import pytest

from epipole.flows import api
from epipole.io.datasets.dataset import read_table
from epipole.schemas.bridge import to_polars
from epipole.schemas.errors import DatasetError
from epipole.schemas.tables import TABLES


def test_all_tables_are_there_with_their_rows(night_dataset):
    tables = api.open_dataset(night_dataset)
    assert tables.nights == ["2019-04-01"]
    assert sorted(tables) == sorted(TABLES)
    for name, rows in tables.items():
        published = to_polars(read_table(night_dataset, name, "2019-04-01"))
        assert rows.drop("night").collect().equals(published), name


def test_the_night_is_a_column(night_dataset):
    positions = api.open_dataset(night_dataset)["positions"]
    of_night = positions.filter(pl.col("night") == datetime.date(2019, 4, 1)).collect()
    assert of_night.height == positions.collect().height > 0
    assert of_night.schema["night"] == pl.Date


def test_nights_of_an_earlier_version_may_lack_columns_and_tables(night_dataset, tmp_path):
    for night, left_out in (("2019-03-31", ["magnitude", "chi2"]), ("2019-04-01", [])):
        for part in night_dataset.glob("night=2019-04-01/*/part-*.parquet"):
            rows = pl.read_parquet(part).drop(left_out, strict=False)
            old = tmp_path / f"night={night}" / part.parent.name / part.name
            if part.parent.name != "sources":
                old.parent.mkdir(parents=True, exist_ok=True)
                rows.write_parquet(old)
    tables = api.open_dataset(tmp_path)
    positions = tables["positions"].collect()
    by_night = (
        positions.group_by("night").agg(pl.col("chi2").null_count(), n=pl.len()).sort("night")
    )
    assert by_night["chi2"].to_list() == [by_night["n"][0], 0]
    assert tables["sources"].collect().height == 0


@pytest.mark.parametrize("folder", ["out[1]", "a*", "site=a/k=1=2/out", "night=all/sensor_id=b"])
def test_a_dataset_may_lie_in_any_folder_beside_copies_of_its_nights(
    folder, night_dataset, tmp_path
):
    out = shutil.copytree(night_dataset, tmp_path / folder)
    shutil.copytree(out / "night=2019-04-01", out / "night=2019-04-01.old")
    positions = api.open_dataset(out)["positions"].collect()
    published = api.open_dataset(night_dataset)["positions"].collect()
    assert positions.equals(published)
    assert positions.schema == published.schema


def test_a_dataset_in_a_store_has_the_same_rows(night_dataset, tmp_path):
    there = api.open_dataset(night_dataset)
    url = api.open_dataset(f"file://{night_dataset}")
    assert url["tracklets"].collect().equals(there["tracklets"].collect())


def test_what_is_no_dataset_is_named(tmp_path):
    with pytest.raises(DatasetError, match="holds no night; make one with `epipole run"):
        api.open_dataset(tmp_path / "out")
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(DatasetError, match="holds other files and no dataset"):
        api.open_dataset(tmp_path)


def test_an_unknown_table_is_named(night_dataset):
    with pytest.raises(KeyError, match="there is no such table; the tables are frames, stars"):
        api.open_dataset(night_dataset)["clouds"]

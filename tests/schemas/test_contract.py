"""What readers rely on: docs/tables.json, no change that breaks them, keys that are keys."""

import copy
import json
from pathlib import Path

import polars as pl
import pytest

from epipole.schemas.columns import values_before
from epipole.schemas.contract import KEYS, breaks, contract
from epipole.schemas.tables import TABLES

ROOT = Path(__file__).parents[2]
SAID = json.loads((ROOT / "docs" / "tables.json").read_text())
NIGHT = "2019-04-01"


@pytest.mark.parametrize("table", SAID)
def test_readers_of_a_table_are_not_broken(table):
    """A column may be added; else raise the table's version in schemas/tables.py."""
    assert table in TABLES, "the table is gone"
    assert list(breaks(SAID[table], contract()[table])) == []


def test_the_page_for_machines_is_up_to_date():
    assert contract() == SAID, "`.ci/generate pages` writes docs/tables.json again"


def without_it(table):
    del table["columns"]["x_km"]
    return "x_km: the column is gone"


def other_unit(table):
    table["columns"]["x_km"]["unit"] = "m"
    return "x_km: unit was km, is m"


def other_type(table):
    table["columns"]["chi2"]["type"] = "float"
    return "chi2: type was double, is float"


def null(table):
    table["columns"]["object_id"]["null"] = True
    return "object_id: may be null, which it was not"


def other_key(table):
    table["key"] = ["object_id"]
    return "key: was epoch, object_id, is object_id"


def no_link(table):
    table["links"] = []
    return "link: object_id does not lead to objects any more"


@pytest.mark.parametrize("change", [without_it, other_unit, other_type, null, other_key, no_link])
def test_a_change_that_breaks_readers_is_told_by_name(change):
    before = contract()["positions"]
    after = copy.deepcopy(before)
    told = change(after)
    assert list(breaks(before, after)) == [told]
    assert list(breaks(before, after | {"version": "2"})) == []


@pytest.mark.parametrize("more", [{"null": True}, {"before": 0.0}])
def test_a_new_column_breaks_nobody(more):
    before = contract()["positions"]
    after = copy.deepcopy(before)
    after["columns"]["worst_sigma"] = after["columns"]["chi2"] | more
    assert list(breaks(before, after)) == []


def test_a_new_column_without_nulls_says_what_it_is_in_earlier_nights():
    before = contract()["positions"]
    after = copy.deepcopy(before)
    after["columns"]["worst_sigma"] = after["columns"]["chi2"]
    (told,) = breaks(before, after)
    assert told.startswith("worst_sigma: is new, may not be null")
    assert values_before(TABLES["calibrations"]) == {"k4": 0.0, "fisheye": False}
    assert values_before(TABLES["nights"]) == {"sensor_ids": [], "known_key": None}


def test_each_column_of_a_key_exists():
    assert set(KEYS) == set(TABLES)
    for table, keys in KEYS.items():
        assert set(keys.columns) <= set(TABLES[table].names)
        for own, other, to in keys.links:
            assert set(own) <= set(TABLES[table].names)
            assert to == KEYS[other].columns


@pytest.fixture(scope="module")
def rows(night_dataset):
    return {
        table: pl.read_parquet(night_dataset / f"night={NIGHT}" / table / "*.parquet")
        for table in TABLES
    }


@pytest.mark.parametrize("table", TABLES)
def test_keys_name_one_row_and_links_lead_to_one(table, rows):
    keys = KEYS[table]
    if keys.columns:
        assert rows[table].select(keys.columns).is_duplicated().sum() == 0
    for own, other, to in keys.links:
        followed = rows[table].select(own).drop_nulls()
        assert len(followed.join(rows[other], left_on=own, right_on=to, how="anti")) == 0, other

"""Recipes: all that a night depends on is in its keys, and nothing else."""

from importlib import metadata

import pytest

from epipole.io.work.recipe import code_key, digest_of, logs_key, recipe_of
from epipole.schemas.given_settings import validate_settings
from epipole.schemas.settings import Settings

NIGHT = "2019-04-01"
A, B = ("a.mcap", "0a"), ("b.mcap", "0b")


def work_key(logs, settings=None, night=NIGHT, known=None):
    return recipe_of(logs_key(logs), settings or Settings(), known).work_key(night)


def test_finished_parts_are_reused_only_for_the_same_logs_settings_and_nights():
    key = work_key([A, B])
    assert key == work_key([B, A])
    other = validate_settings({"tracklets": {"gate_sigma": 5.0}}, "test")
    assert key != work_key([A, B], other)
    assert key != work_key([A])
    assert key != work_key([A, ("c.mcap", B[1])])
    assert key != work_key([A, B], night="2019-04-02")


def test_parts_lie_under_the_numbers_of_the_sensors_of_a_run():
    recipe = recipe_of(logs_key([A]), Settings())
    keys = {recipe.work_key(NIGHT, run) for run in ((), ("s1", "s2"), ("s0", "s1", "s2"))}
    assert len(keys) == 3


def test_names_are_given_after_the_parts_so_the_parts_do_not_depend_on_them():
    assert work_key([A]) == work_key([A], known="f00")
    assert recipe_of("", Settings()) != recipe_of("", Settings(), "f00")


def test_of_logs_with_the_same_bytes_the_first_name_counts():
    copy = ("z.mcap", A[1])
    assert logs_key([A]) == logs_key([copy, A])
    assert logs_key([A]) != logs_key([copy])


def test_a_star_catalogue_counts_by_its_bytes(tmp_path):
    file = tmp_path / "stars.parquet"
    keys = []
    for content in (b"one", b"two", b"one"):
        file.write_bytes(content)
        settings = validate_settings({"identification": {"catalogue": str(file)}}, "test")
        keys.append(recipe_of("", settings).star_catalogue)
    assert keys[0] == keys[2] != keys[1]


@pytest.mark.parametrize("library", ["astropy-iers-data", "numpy", "sgp4"])
def test_a_night_made_with_another_version_of_what_its_rows_depend_on_is_another_one(
    library, monkeypatch
):
    before, version = code_key(), metadata.version
    monkeypatch.setattr(metadata, "version", lambda name: version(name) + "+" * (name == library))
    assert code_key.__wrapped__() != before


def test_digests_do_not_run_together():
    assert digest_of(["ab", "c"]) != digest_of(["a", "bc"])
    assert len(code_key()) == 64

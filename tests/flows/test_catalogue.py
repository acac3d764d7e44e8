"""`epipole catalog build`, and a run with what it built."""

import json
import sys

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest

from epipole.flows.command_line.main import main
from epipole.io.catalogues.star_catalogue import read_star_catalogue
from epipole.schemas.bridge import array
from epipole.schemas.star_lists import label_of


@pytest.fixture
def epipole(monkeypatch, capfd, tmp_path, no_early_server):
    """Return a function that runs a command line and gives (exit code, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["epipole", *map(str, arguments)])
        capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code or 0, *capfd.readouterr()

    return call


def test_hipparcos_is_built_and_told_in_a_few_lines(epipole, tmp_path):
    code, out, _ = epipole("catalog", "build", "hipparcos", "--out", "hip.parquet", "--limit", 7)
    assert code == 0
    assert "hipparcos, positions at 1991.25" in out
    assert "identification.catalogue = 'hip.parquet'" in out
    stars = read_star_catalogue(str(tmp_path / "hip.parquet"))
    assert stars.num_rows == pytest.approx(15_500, rel=0.05)
    assert array(stars, "magnitude").max() <= 7.0


def test_a_list_of_ones_own_is_built_and_told_as_json(epipole, tmp_path):
    (tmp_path / "mine.csv").write_text(
        "star_id,ra_deg,dec_deg,magnitude,variable,b_v\n1,10,20,5.5,true,0.3\n2,30,40,6.5,false,1\n"
    )
    arguments = "mine.csv --out built/mine.parquet --epoch 2015.5 --name ours --json"
    code, out, _ = epipole("catalog", "build", *arguments.split())
    told = json.loads(out)
    assert code == 0
    assert (told["name"], told["epoch"], told["stars"]) == ("ours", 2015.5, 2)
    assert (told["without_motion"], told["variable"], told["ignored"]) == (2, 1, ["b_v"])
    stars = read_star_catalogue(str(tmp_path / "built" / "mine.parquet"))
    assert label_of(stars.schema)[:2] == ("ours", 2015.5)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ("none.csv", "none.csv: no such file; give hipparcos, deep, or"),
        ("hipparcos --epoch 2000", "hipparcos has an epoch and a name"),
        ("hipparcos --limit -5", "no star of magnitude -5.0 or brighter"),
        (
            "mine.csv --epoch 2000",
            "1 of 2 rows are invalid; correct or remove them: row 2: dec_deg = 90.5",
        ),
        ("mine.csv --epoch 2000 --name hipparcos", "the name hipparcos is reserved"),
    ],
)
def test_what_cannot_be_built_is_told_in_one_line_and_nothing_written(
    epipole, tmp_path, arguments, said
):
    (tmp_path / "mine.csv").write_text("star_id,ra_deg,dec_deg,magnitude\n1,1,1,1\n2,2,90.5,2\n")
    code, _, err = epipole("catalog", "build", *arguments.split(), "--out", "out.parquet")
    assert code == 1
    assert said in err
    assert len(err.splitlines()) == 1
    assert not (tmp_path / "out.parquet").exists()


def test_a_list_of_stars_is_not_replaced_by_its_catalogue(epipole, tmp_path):
    text = "star_id,ra_deg,dec_deg,magnitude\n1,1,1,1\n"
    (tmp_path / "mine.csv").write_text(text)
    code, _, err = epipole("catalog", "build", "mine.csv", "--epoch", "2000", "--out", "mine.csv")
    assert code == 1
    assert "mine.csv: is the source, and would be lost" in err
    assert (tmp_path / "mine.csv").read_text() == text


def test_a_run_names_a_catalogue_that_is_not_there_before_it_starts(epipole, tmp_path, night_log):
    (tmp_path / "settings.toml").write_text('[identification]\ncatalogue = "none.parquet"\n')
    code, _, err = epipole("run", night_log, "--out", "out", "--settings", "settings.toml")
    assert code == 1
    assert "epipole: none.parquet: no such catalogue file" in err


@pytest.mark.long
def test_a_run_uses_the_catalogue_of_the_settings_and_names_it_beside_its_ids(
    epipole, tmp_path, night_log, night_dataset
):
    from epipole.flows.nightly import nightly

    # Hipparcos under other numbers and another name.
    epipole("catalog", "build", "hipparcos", "--out", "hip.parquet")
    stars = pl.read_parquet("hip.parquet").with_columns(pl.col("star_id") + 1_000_000)
    stars.write_csv("mine.csv")
    epipole("catalog", "build", "mine.csv", "--out", "mine.parquet", "--epoch", 1991.25)

    out = tmp_path / "out"
    nightly([str(night_log)], str(out), {"identification": {"catalogue": "mine.parquet"}})
    (mine,) = out.glob("night=*/stars/*.parquet")
    (theirs,) = night_dataset.glob("night=*/stars/*.parquet")
    assert pq.read_schema(mine).metadata[b"catalogue"] == b"mine"
    assert pq.read_schema(theirs).metadata[b"catalogue"] == b"hipparcos"
    found, expected = (array(pq.read_table(p), "star_id") for p in (mine, theirs))
    np.testing.assert_array_equal(found, expected + 1_000_000)

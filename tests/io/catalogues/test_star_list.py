"""Star lists of users."""

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.io.catalogues.star_list import read_star_list
from epipole.schemas.bridge import array
from epipole.schemas.errors import CatalogueError
from epipole.schemas.star_lists import STAR_CATALOGUE, UNKNOWN_MOTION_MAS_YR, label_of

HEADER = "star_id,ra_deg,dec_deg,magnitude"


@pytest.fixture
def csv(tmp_path):
    """Return a function that writes lines to a CSV file."""

    def write(*lines):
        path = tmp_path / "mine.csv"
        path.write_text("\n".join(lines) + "\n")
        return path

    return write


@pytest.fixture
def parquet(tmp_path):
    """Return a function that writes columns to a Parquet file."""

    def write(columns):
        path = tmp_path / "mine.parquet"
        pl.DataFrame(columns).write_parquet(path)
        return path

    return write


def many(**changes):
    """Return columns of 200 stars all over the sky."""
    rng = np.random.default_rng(0)
    columns = {
        "star_id": np.arange(200),
        "ra_deg": rng.uniform(0, 360, 200),
        "dec_deg": np.degrees(np.arcsin(rng.uniform(-1, 1, 200))),
        "magnitude": rng.uniform(0, 9, 200),
    }
    return columns | {name: change(columns[name]) for name, change in changes.items()}


def test_the_four_needed_columns_are_enough(csv):
    read = read_star_list(csv(HEADER, "7,10.5,-20.25,5.5", "8,0,90,6"), epoch=2016.0)
    assert array(read.stars, "star_id").tolist() == [7, 8]
    assert array(read.stars, "ra_deg").tolist() == [10.5, 0.0]
    assert array(read.stars, "dec_deg").tolist() == [-20.25, 90.0]
    for name in ("pm_ra_mas_yr", "pm_dec_mas_yr", "parallax_mas", "sigma_mas"):
        assert array(read.stars, name).tolist() == [0.0, 0.0]
    assert array(read.stars, "pm_sigma_mas_yr").tolist() == [UNKNOWN_MOTION_MAS_YR] * 2
    assert not array(read.stars, "variable").any()
    assert read.ignored == []


def test_a_motion_that_is_given_is_not_taken_as_unknown(csv):
    path = csv(f"{HEADER},pm_ra_mas_yr,pm_dec_mas_yr,variable", "1,1,1,1,5,-6,true", "2,2,2,2,,,0")
    stars = read_star_list(path, epoch=2016.0).stars
    assert array(stars, "pm_ra_mas_yr").tolist() == [5.0, 0.0]
    assert array(stars, "pm_sigma_mas_yr").tolist() == [0.0, UNKNOWN_MOTION_MAS_YR]
    assert array(stars, "variable").tolist() == [True, False]


def test_name_epoch_and_content_of_the_file_stand_in_the_label(csv):
    path = csv(HEADER, "1,1,1,1")
    label = label_of(read_star_list(path, epoch=2000.0).stars.schema)
    assert label[:2] == ("mine", 2000.0)
    assert label.source.startswith("mine.csv (sha256 ")
    assert label_of(read_star_list(path, 2000.0, "theirs").stars.schema).name == "theirs"
    again = csv(HEADER, "1,1,1,2")
    assert label_of(read_star_list(again, epoch=2000.0).stars.schema).source != label.source


def test_columns_that_are_not_used_are_told(csv):
    read = read_star_list(csv(f"{HEADER},pmra,note", "1,1,1,1,5,x"), epoch=2000.0)
    assert read.ignored == ["pmra", "note"]


def test_bad_rows_are_named_by_row_and_column(csv):
    path = csv(
        f"{HEADER},pm_ra_mas_yr,pm_dec_mas_yr,parallax_mas,variable",
        "1,10,20,5,,,,",
        "2,10,97.2,5,,,,",
        "x3,10,20,5,,,,",
        "4,10,20,,,,,",
        "5,10,20,bright,,,,",
        "6,10,20,5,3,,,",
        "7,10,20,5,,,2000,",
        "8,10,20,5,,,,maybe",
        "9,-10,20,5,,,,",
    )
    with pytest.raises(CatalogueError) as error:
        read_star_list(path, epoch=2000.0)
    message = str(error.value)
    assert "8 of 9 rows are invalid" in message
    assert "row 2: dec_deg = 97.2, not within -90 to 90" in message
    assert "row 3: star_id = x3, not a whole number" in message
    assert "row 4: magnitude is empty" in message
    assert "row 5: magnitude = bright, not a number" in message
    assert "row 6: pm_" in message
    assert "and 3 more" in message


@pytest.mark.parametrize(
    ("column", "value", "why"),
    [
        ("ra_deg", "-10", "not within 0 to 360"),
        ("ra_deg", "inf", "not within 0 to 360"),
        ("magnitude", "99.99", "not within -30 to 40"),
        ("pm_ra_mas_yr", "20000", "not within"),
        ("parallax_mas", "2000", "not within"),
        ("sigma_mas", "-1", "not within 0"),
        ("variable", "maybe", "not true or false"),
        ("star_id", "1.5", "not a whole number"),
    ],
)
def test_each_column_has_its_bounds(csv, column, value, why):
    row = {"star_id": "1", "ra_deg": "1", "dec_deg": "1", "magnitude": "1"}
    row |= {"pm_ra_mas_yr": "0", "pm_dec_mas_yr": "0", column: value}
    with pytest.raises(CatalogueError, match=f"row 1: {column} = {value}, {why}"):
        read_star_list(csv(",".join(row), ",".join(row.values())), epoch=2000.0)


def test_a_number_that_two_stars_have_is_named_in_both_rows(csv):
    with pytest.raises(
        CatalogueError, match=r"row 1: star_id = 5, another row has.*row 3: star_id"
    ):
        read_star_list(csv(HEADER, "5,1,1,1", "6,2,2,2", "5,3,3,3"), epoch=2000.0)


def test_missing_columns_are_named_beside_those_that_are_there(csv):
    with pytest.raises(CatalogueError, match="no column ra_deg, dec_deg; it has star_id, ra, dec"):
        read_star_list(csv("star_id,ra,dec,magnitude", "1,1,1,1"), epoch=2000.0)


@pytest.mark.parametrize("epoch", [None, 0.0, 2459000.5])
def test_an_epoch_is_asked_for_and_must_be_a_year(csv, epoch):
    with pytest.raises(CatalogueError, match=r"epoch.*2016\.0"):
        read_star_list(csv(HEADER, "1,1,1,1"), epoch=epoch)


@pytest.mark.parametrize("lines", [(), (HEADER,), (HEADER, "1,2,3,4,5,6")])
def test_a_file_without_stars_or_of_uneven_lines_is_refused(csv, lines):
    with pytest.raises(CatalogueError, match=r"mine\.csv"):
        read_star_list(csv(*lines), epoch=2000.0)


def test_parquet_files_of_other_tools_give_the_same_stars(parquet):
    columns = many()
    columns["pm_ra_mas_yr"] = columns["pm_dec_mas_yr"] = np.full(200, np.nan)
    columns["variable"] = np.arange(200) < 5
    stars = read_star_list(parquet(columns), epoch=2016.0).stars
    np.testing.assert_array_equal(array(stars, "ra_deg"), columns["ra_deg"])
    assert array(stars, "variable").sum() == 5
    assert np.all(array(stars, "pm_sigma_mas_yr") == UNKNOWN_MOTION_MAS_YR)


@pytest.mark.parametrize(
    ("changes", "unit"),
    [
        ({"ra_deg": np.radians, "dec_deg": np.radians}, "radians"),
        ({"ra_deg": lambda ra: ra / 15}, "hours"),
    ],
)
def test_a_sky_in_another_unit_is_told_from_degrees(parquet, changes, unit):
    with pytest.raises(CatalogueError, match=f"as {unit} do; give degrees"):
        read_star_list(parquet(many(**changes)), epoch=2016.0)


@pytest.mark.parametrize(
    ("star_id", "says"),
    [
        (1.5, "row 200: star_id = 1.5, not a whole number"),
        (4472832130942575872.0, "row 200: star_id = .* too large for floating-point numbers"),
        (np.nan, "row 200: star_id = nan, not a whole number"),
    ],
)
def test_ids_that_floating_point_numbers_do_not_hold_are_refused(parquet, star_id, says):
    columns = many(star_id=lambda ids: np.where(ids == 199, star_id, ids.astype(float)))
    with pytest.raises(CatalogueError, match=says):
        read_star_list(parquet(columns), epoch=2016.0)


def test_a_patch_of_sky_in_degrees_is_not_taken_for_radians(parquet):
    columns = many(ra_deg=lambda ra: ra / 360 * 4, dec_deg=lambda dec: dec / 90)
    assert read_star_list(parquet(columns), epoch=2016.0).stars.num_rows == 200


def test_a_column_that_says_another_unit_is_refused(tmp_path):
    fields = [f.with_metadata({}) for f in STAR_CATALOGUE]
    fields[1] = fields[1].with_metadata({"unit": "rad"})
    stars = read_hipparcos().slice(0, 3)
    path = tmp_path / "rad.parquet"
    pq.write_table(pa.Table.from_arrays(stars.columns, schema=pa.schema(fields)), path)
    with pytest.raises(CatalogueError, match="ra_deg is in rad; it must be in deg"):
        read_star_list(path, epoch=2000.0)


def test_a_catalogue_that_was_built_can_be_built_from_again(tmp_path):
    stars = read_hipparcos().slice(0, 500)
    path = tmp_path / "again.parquet"
    pq.write_table(stars, path)
    again = read_star_list(path).stars
    assert label_of(again.schema)[:2] == ("again", 1991.25)
    assert again.replace_schema_metadata().equals(stars.replace_schema_metadata())

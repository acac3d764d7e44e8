"""Catalogue files, and the catalogue that a setting names."""

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.io.catalogues.star_catalogue import (
    check_star_catalogue,
    read_star_catalogue,
    write_star_catalogue,
)
from epipole.io.work.recipe import star_catalogue_key
from epipole.schemas.errors import CatalogueError
from epipole.schemas.options import STAR_CATALOGUES
from epipole.schemas.star_lists import CatalogueLabel, label_of, labelled


@pytest.fixture(scope="module")
def few():
    """Return a hundred stars under a name of their own."""
    return labelled(read_hipparcos().slice(0, 100), CatalogueLabel("few", 1991.25, "a test"))


def test_hipparcos_needs_no_file_and_says_what_it_is():
    stars = read_star_catalogue("hipparcos")
    assert stars.num_rows == 117_955
    assert label_of(stars.schema)[:2] == ("hipparcos", 1991.25)
    check_star_catalogue("hipparcos")


def read_few():
    """Return ten stars of a catalogue that a test registers."""
    return labelled(read_hipparcos().slice(0, 10), CatalogueLabel("registered", 1991.25, "a test"))


def test_a_second_catalogue_is_one_line_of_the_registry(monkeypatch):
    source = STAR_CATALOGUES["hipparcos"]._replace(read=f"{__name__}:read_few", package="numpy")
    monkeypatch.setitem(STAR_CATALOGUES, "registered", source)
    check_star_catalogue("registered")
    assert read_star_catalogue("registered").num_rows == 10
    assert star_catalogue_key("registered") == f"registered {np.__version__}"


def test_a_catalogue_comes_back_as_it_was_written(few, tmp_path):
    path = tmp_path / "new" / "few.parquet"
    write_star_catalogue(path, few)
    check_star_catalogue(str(path))
    assert read_star_catalogue(str(path)).equals(few, check_metadata=True)
    assert [p.name for p in path.parent.iterdir()] == ["few.parquet"]


def test_name_epoch_and_source_stand_in_the_files_own_metadata(few, tmp_path):
    write_star_catalogue(tmp_path / "few.parquet", few)
    words = pq.read_metadata(tmp_path / "few.parquet").metadata
    assert words[b"catalogue"] == b"few"
    assert words[b"epoch"] == b"1991.25"
    assert words[b"source"] == b"a test"


def test_a_missing_file_is_named_with_what_may_be_given():
    with pytest.raises(
        CatalogueError, match=r'none\.parquet: no such .* "hipparcos" or to the path'
    ):
        check_star_catalogue("none.parquet")


@pytest.mark.parametrize("content", [b"", b"PAR1 and then nothing", b"star_id,ra_deg\n1,2\n"])
def test_a_file_that_is_no_parquet_is_refused(content, tmp_path):
    path = tmp_path / "stars.parquet"
    path.write_bytes(content)
    with pytest.raises(CatalogueError, match="epipole catalog build"):
        check_star_catalogue(str(path))


def test_a_table_that_is_no_catalogue_is_refused(few, tmp_path):
    path = tmp_path / "other.parquet"
    pq.write_table(few.replace_schema_metadata({}), path)
    with pytest.raises(CatalogueError, match="no catalogue in the metadata"):
        check_star_catalogue(str(path))
    pq.write_table(few.drop_columns(["magnitude"]), path)
    with pytest.raises(CatalogueError, match="magnitude"):
        read_star_catalogue(str(path))


def test_a_star_without_a_place_is_named(few, tmp_path):
    at = few.column_names.index("dec_deg")
    dec = few["dec_deg"].to_numpy().copy()
    dec[41] = np.nan
    path = tmp_path / "few.parquet"
    pq.write_table(few.set_column(at, few.schema.field(at), pa.array(dec)), path)
    with pytest.raises(CatalogueError, match="row 42, dec_deg"):
        read_star_catalogue(str(path))


def test_a_damaged_file_is_refused(few, tmp_path):
    path = tmp_path / "few.parquet"
    write_star_catalogue(path, few)
    content = bytearray(path.read_bytes())
    content[4:600] = b"\0" * 596
    path.write_bytes(content)
    with pytest.raises(CatalogueError, match="cannot be read"):
        read_star_catalogue(str(path))


def test_a_place_that_cannot_be_written_to_is_named(few, tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(CatalogueError, match="cannot be written"):
        write_star_catalogue(tmp_path / "file" / "few.parquet", few)

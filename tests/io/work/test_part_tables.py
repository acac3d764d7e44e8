"""Declared tables of parts: the right ones pass, any other table or column is refused."""

import pyarrow as pa
import pytest

from epipole.io.work import part_tables
from epipole.io.work.part_tables import IDENTIFIED, TRACKED, check_tables
from epipole.schemas.bridge import empty, table_name

KINDS = {
    name: kind
    for name, kind in vars(part_tables).items()
    if isinstance(kind, dict) and name.isupper()
}


@pytest.mark.parametrize("kind", KINDS)
def test_the_declared_tables_of_each_kind_pass(kind):
    check_tables("here", KINDS[kind], {name: empty(s) for name, s in KINDS[kind].items()})


@pytest.mark.parametrize("kind", KINDS)
def test_every_table_has_a_schema_with_a_name(kind):
    assert KINDS[kind]
    assert all(table_name(schema) for schema in KINDS[kind].values())


def test_a_missing_or_unknown_table_is_refused():
    tables = {name: empty(schema) for name, schema in TRACKED.items()}
    with pytest.raises(ValueError, match=r"here: tables \['detections'\], expected"):
        check_tables("here", TRACKED, {"detections": tables["detections"]})
    with pytest.raises(ValueError, match="more"):
        check_tables("here", TRACKED, tables | {"more": tables["detections"]})


def test_a_column_of_another_type_or_that_may_be_null_is_refused():
    tables = {name: empty(schema) for name, schema in TRACKED.items()}
    at = TRACKED["tracklets"].get_field_index("n_detections")
    field = TRACKED["tracklets"].field(at)
    for other in (field.with_type(pa.int64()), field.with_nullable(True)):
        wrong = TRACKED["tracklets"].set(at, other).empty_table()
        with pytest.raises(ValueError, match=r"table tracklets: columns .*n_detections"):
            check_tables("here", TRACKED, tables | {"tracklets": wrong})


def test_metadata_may_be_added():
    tables = {name: empty(schema) for name, schema in IDENTIFIED.items()}
    named = tables["stars"].replace_schema_metadata({b"catalogue": b"gaia"})
    check_tables("here", IDENTIFIED, tables | {"stars": named})

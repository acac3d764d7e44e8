"""Parts: whole or not at all, the first writer's stays, rows found across spans."""

import shutil

import numpy as np
import pyarrow as pa
import pytest

from epipole.io.work import parts as part_tables
from epipole.io.work.parts import (
    IDENTIFIED,
    TRACKED,
    Parts,
    check_tables,
    is_written,
    read_part,
    write_part,
)
from epipole.schemas.bridge import empty, table_name
from epipole.schemas.columns import TIME
from epipole.schemas.errors import DatasetError
from epipole.schemas.spans import SPAN_NS, Span

SCHEMA = pa.schema([pa.field("time", TIME), pa.field("value", pa.int64())])
ONE = {"a": SCHEMA}
SPANS = [Span(k * SPAN_NS, (k + 1) * SPAN_NS) for k in range(3)]


def rows(*time_ns: int) -> pa.Table:
    times = pa.array(np.array(time_ns, np.int64)).cast(TIME)
    return pa.Table.from_arrays([times, pa.array(range(len(time_ns)), pa.int64())], schema=SCHEMA)


def test_what_is_written_is_read_again(tmp_path):
    part = tmp_path / "stage" / "1"
    assert not is_written(part)
    write_part(part, {"a": SCHEMA, "b": SCHEMA}, {"a": rows(1, 2), "b": rows()})
    assert is_written(part)
    assert read_part(part, "a").equals(rows(1, 2))
    assert read_part(part, "b").num_rows == 0
    assert read_part(part, "a", ["value"]).column_names == ["value"]
    assert [p.name for p in part.parent.iterdir()] == ["1"]  # nothing half made is left


def test_a_part_that_exists_is_unchanged(tmp_path):
    write_part(tmp_path / "1", ONE, {"a": rows(1)})
    write_part(tmp_path / "1", ONE, {"a": rows(1, 2, 3)})
    assert read_part(tmp_path / "1", "a").num_rows == 1


def test_a_missing_or_damaged_table_is_an_error_for_people(tmp_path):
    write_part(tmp_path / "1", ONE, {"a": rows(1)})
    with pytest.raises(DatasetError, match=r"cannot be read.*run again"):
        read_part(tmp_path / "1", "b")
    (tmp_path / "1" / "a.arrow").write_bytes(b"no arrow")
    with pytest.raises(DatasetError, match="cannot be read"):
        read_part(tmp_path / "1", "a")


def test_a_folder_that_cannot_be_made_is_an_error_for_people(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match="cannot be written"):
        write_part(tmp_path / "file" / "1", ONE, {"a": rows(1)})


def test_a_task_that_outlives_its_run_does_not_bring_its_folder_back(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    write_part(run / "read" / "1", ONE, {"a": rows(1)}, within=run)
    shutil.rmtree(run)
    with pytest.raises(DatasetError, match="its run has ended"):
        write_part(run / "read" / "2", ONE, {"a": rows(1)}, within=run)
    assert not run.exists()


def test_rows_within_a_span_come_from_all_parts_that_it_touches(tmp_path):
    parts = Parts(tmp_path)
    border = SPANS[1].start_ns
    # The second part holds a frame whose corrected time lies in the first span.
    write_part(parts.of(SPANS[0]), ONE, {"a": rows(5, border - 1)})
    write_part(parts.of(SPANS[1]), ONE, {"a": rows(border - 2, border, border + 9)})
    found = parts.rows_within(SPANS[0], SCHEMA, "a")
    assert found["time"].cast(pa.int64()).to_pylist() == [5, border - 1, border - 2]
    found = parts.rows_within(SPANS[1], SCHEMA, "a")
    assert found["time"].cast(pa.int64()).to_pylist() == [border, border + 9]
    assert parts.rows_within(SPANS[2], SCHEMA, "a").num_rows == 0
    assert [parts.holds(span) for span in SPANS] == [True, True, False]


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

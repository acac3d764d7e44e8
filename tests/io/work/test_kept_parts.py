"""Kept parts: keys of rows and values, and folders of other runs of the night."""

import pyarrow as pa
import pytest

from epipole.io.work.folder import work_folder
from epipole.io.work.kept_parts import key_of, part_key
from epipole.io.work.parts import Parts, write_part
from epipole.io.work.recipe import recipe_of
from epipole.schemas.given_settings import validate_settings
from epipole.schemas.settings import Settings
from epipole.schemas.spans import SPAN_NS, Span

NIGHT = "2019-04-01"
SPAN, NEXT = (Span(k * SPAN_NS, (k + 1) * SPAN_NS) for k in range(2))
ROWS = pa.table({"name": ["a", None, "c"], "value": [[1.0], [2.0, 3.0], []]})
DECLARED = {"rows": ROWS.schema}
KEY = part_key(["x"], [ROWS])


def make(folder, key, rows=ROWS, span=SPAN) -> bool:
    """Make a part of a run as a task does; return whether it could be taken."""
    parts = folder.viewed(0)[0]
    taken = parts.take(span, key)
    if not taken:
        write_part(parts.of(span), DECLARED, {"rows": rows}, key=key)
    assert parts.read(span, "rows").equals(rows)
    return taken


def run(root, logs, settings=None, keep=False, key=KEY) -> bool:
    recipe = recipe_of(logs, settings or Settings())
    with work_folder(root, NIGHT, recipe, keep) as folder:
        return make(folder, key)


def stopped_run(root, logs, parts) -> None:
    """Make some parts in a run that is stopped then."""
    with work_folder(root, NIGHT, recipe_of(logs, Settings())) as folder:
        for key, span in parts:
            make(folder, key, span=span)
        raise KeyboardInterrupt


def test_equal_rows_have_one_key_however_they_are_divided():
    key = part_key(["x"], [ROWS])
    halves = pa.concat_tables([ROWS.slice(0, 1), ROWS.slice(1)])
    assert key == part_key(["x"], [halves])
    assert key == part_key(["x"], [pa.concat_tables([ROWS, ROWS]).slice(3)])


def test_other_rows_names_and_values_have_other_keys():
    others = [
        part_key(["x"], [ROWS]), part_key(["y"], [ROWS]), part_key(["x"], [ROWS, ROWS]),
        part_key(["x"], [ROWS.slice(1)]), part_key(["x"], [ROWS.slice(0, 0)]), part_key(["x"]),
        part_key(["x"], [ROWS.rename_columns(["name", "other"])]),
        part_key(["x"], [ROWS.set_column(0, "name", [["a", "b", "c"]])]),
        part_key(["x", None], [ROWS]), part_key([("x", None)], [ROWS]),
    ]  # fmt: skip
    assert len(set(others)) == len(others)


def test_a_part_has_the_key_it_was_written_with(tmp_path):
    write_part(tmp_path / "1", DECLARED, {"rows": ROWS}, key=part_key(["x"]))
    write_part(tmp_path / "2", DECLARED, {"rows": ROWS})
    assert key_of(tmp_path / "1") == part_key(["x"])
    assert key_of(tmp_path / "2") is None
    assert key_of(tmp_path / "3") is None
    (tmp_path / "1" / "key").write_text("../../secret")
    assert key_of(tmp_path / "1") is None


def test_several_parts_have_a_key_only_where_each_has_one(tmp_path):
    parts = Parts(tmp_path)
    write_part(parts.of(SPAN), DECLARED, {"rows": ROWS}, key=part_key(["x"]))
    one = part_key([], parts=parts.written([SPAN, NEXT]))  # the second span has no part
    assert one is not None
    write_part(parts.of(NEXT), DECLARED, {"rows": ROWS})
    assert part_key([], parts=parts.written([SPAN, NEXT])) is None
    assert part_key([], parts=parts.written([SPAN])) == one


def test_a_finished_run_keeps_its_parts_only_where_asked(tmp_path):
    assert not run(tmp_path, "a")
    assert not run(tmp_path, "b", keep=True)
    assert run(tmp_path, "c", keep=True)
    assert run(tmp_path, "c")
    assert list(tmp_path.iterdir()) == []


def test_parts_of_other_rows_settings_or_nights_are_not_taken(tmp_path):
    run(tmp_path, "a", keep=True)
    assert not run(tmp_path, "b", keep=True, key=part_key(["other"]))
    assert not run(tmp_path, "c", keep=True)  # what the run before could not use is gone
    other = validate_settings({"tracklets": {"gate_sigma": 5.0}}, "test")
    assert not run(tmp_path, "c", other, keep=True)
    assert len(list(tmp_path.iterdir())) == 1  # those of other settings are gone
    with work_folder(tmp_path, "2019-04-02", recipe_of("c", other)) as folder:
        assert not make(folder, KEY)


def test_a_stopped_run_leaves_its_parts_to_a_run_with_other_logs(tmp_path):
    for logs, parts in (("a", [(KEY, SPAN), (None, NEXT)]), ("b", [])):
        with pytest.raises(KeyboardInterrupt):
            stopped_run(tmp_path, logs, parts)
    assert run(tmp_path, "c")
    assert list(tmp_path.iterdir()) == []

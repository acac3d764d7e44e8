"""The README: its generated parts are what the program makes.

Run as a script it writes them again: ``python tests/test_readme.py``, where `out/` holds the
dataset of the README's first command.
"""

import contextlib
import io
import re
import sys
from pathlib import Path

import polars as pl
import pytest

from epipole.schemas.tables import TABLES

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
EXAMPLE = ROOT / "examples" / "four_sensor_geo.mcap"


def part(text: str, name: str) -> str:
    """Return what stands between a part's two marks."""
    found = re.search(rf"<!-- {name} -->\n(.*?)<!-- end of {name} -->", text, re.DOTALL)
    assert found, f"README.md has no part {name}"
    return found[1]


def with_part(text: str, name: str, content: str) -> str:
    before, rest = text.split(f"<!-- {name} -->\n")
    return (
        f"{before}<!-- {name} -->\n{content}<!-- end of {name} -->"
        + rest.split(f"<!-- end of {name} -->", 1)[1]
    )


def tables() -> str:
    """Return the table of tables, from the schemas."""
    rows = ["| table | one row is | columns |", "|---|---|---|"]
    for name, schema in TABLES.items():
        doc = schema.metadata[b"doc"].decode().removeprefix("One row ").rstrip(".")
        rows.append(f"| `{name}` | {doc} | {', '.join(schema.names)} |")
    return "\n".join(rows) + "\n"


def output(folder: Path) -> str:
    """Return what the README's query prints where `folder` holds out/."""
    query = part(README.read_text(), "query").split("```")[1].removeprefix("python\n")
    query = query.replace('"out/', f'"{folder}/out/')
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed), pl.Config(tbl_width_chars=100):
        exec(query, {})
    return f"```\n{printed.getvalue()}```\n"


def test_the_table_of_tables_is_that_of_the_schemas():
    assert part(README.read_text(), "tables") == tables()


@pytest.mark.parametrize(
    "command",
    [
        "python -m pip install . && epipole run examples/four_sensor_geo.mcap --out out/",
        "python -m pip install '.[test]' && pytest -q",
    ],
)
def test_the_two_commands_stand_as_they_are(command):
    assert f"\n{command}\n" in README.read_text()


def test_the_query_prints_what_the_readme_says(prefect, tmp_path):
    from epipole.flows.nightly import nightly

    nightly([str(EXAMPLE)], str(tmp_path / "out"))
    assert output(tmp_path) == part(README.read_text(), "output")


def test_the_questions_have_answers(night_dataset):
    code = part(README.read_text(), "questions").split("```")[1].removeprefix("python\n")
    names: dict = {}
    exec(code.replace('"out/', f'"{night_dataset}/'), names)
    assert all(len(names[name]) for name in ("one_object", "came_near", "ten_minutes"))


def test_links_lead_to_files():
    for target in re.findall(r"\]\(([^)#:]+)\)", README.read_text()):
        assert (ROOT / target).exists(), target


if __name__ == "__main__":
    written = with_part(README.read_text(), "tables", tables())
    written = with_part(written, "output", output(Path.cwd()))
    README.write_text(written)
    sys.exit(0)

"""The page of benchmarks: its parts are those of the plan, and what is printed becomes tables."""

import re
import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))

from page import (
    MACHINE,
    OF_README,
    PAGE,
    PLAN,
    README,
    Benchmark,
    Result,
    as_markdown,
    part_of,
    run,
    shown,
    write_page,
)

MAX_WORDS = 4000


def result(output="| a |\n|---|\n| 1 |\n", commit="abc"):
    return Result(output, 12.3, "2031-04-01", commit, "2 cores")


def test_the_page_has_a_part_for_each_benchmark_of_the_plan_in_its_order():
    marks = re.findall(r"<!-- (?!end of )(\w+) -->", PAGE.read_text())
    assert marks == [MACHINE, *(name for name in PLAN if name != OF_README)]
    assert f"<!-- {OF_README} -->" in README.read_text()


def test_the_plan_names_scripts_that_exist():
    for benchmark in PLAN.values():
        assert Path(__file__).with_name(f"bench_{benchmark.script}.py").exists()


def test_the_page_is_short():
    words = [word for word in PAGE.read_text().split() if re.search(r"\w", word)]
    assert len(words) <= MAX_WORDS


def test_tables_stay_tables_and_other_lines_are_fenced():
    said = as_markdown("Camera a\n| x | y |\n| 1 | 2 |\n\ndone\n")
    assert said.split("\n\n") == [
        "```text\nCamera a\n```",
        "| x | y |\n|---|---|\n| 1 | 2 |",
        "```text\ndone\n```\n",
    ]


def test_of_a_long_output_only_some_lines_and_columns_are_shown():
    said = "Camera a\n| x | y | z |\n|---|---|---|\n| 1 | 2 | 3 |\n| 4 | 5 | 6 |\n\nin 3 s\n"
    assert shown(said, Benchmark("clocks")).split() == said.split()
    one = Benchmark("clocks", lines="Camera|5", columns=("z", "x"))
    assert shown(said, one) == "Camera a\n| z | x |\n|---|---|\n| 6 | 4 |"
    with pytest.raises(ValueError, match="other"):
        shown(said, Benchmark("clocks", columns=("other",)))


def test_a_part_names_its_commit_only_if_the_page_has_no_common_one():
    one = Benchmark("clocks", "--offsets 0.1")
    assert part_of(one, result(), alone=False).startswith(
        "`python tests/benchmarks/bench_clocks.py --offsets 0.1` (12 s).\n\n| a |"
    )
    assert "2031-04-01, commit abc; 2 cores." in part_of(one, result(), alone=True)
    said = part_of(one, result(), alone=True, on_one_machine=True)
    assert "2031-04-01, commit abc." in said


@pytest.fixture
def copy(tmp_path, monkeypatch):
    page = tmp_path / "BENCHMARKS.md"
    page.write_text(PAGE.read_text())
    monkeypatch.setattr("page.PAGE", page)
    readme = tmp_path / "README.md"
    readme.write_text(README.read_text())
    monkeypatch.setattr("page.README", readme)
    return page


def test_a_whole_round_has_one_date_commit_and_machine(copy):
    heads = {name: f"| {' | '.join(each.columns or 'a')} |\n" for name, each in PLAN.items()}
    write_page({name: result(head) for name, head in heads.items()})
    minutes = round(12.3 * len(PLAN) / 60)
    assert f"All tables: 2031-04-01, commit abc; 2 cores; {minutes} minutes." in copy.read_text()
    assert copy.read_text().count("commit abc") == 1


def test_parts_that_are_not_measured_stay_as_they_are(copy):
    before = copy.read_text()
    write_page({"clocks": result()})
    text = copy.read_text()
    assert "Not all tables are of one commit yet" in text
    start = before.index("<!-- end of clocks -->")
    assert before[start:] in text
    # The part of the machine is measured too.
    assert before[: before.index("<!-- machine -->")] in text
    first = before.index("<!-- end of machine -->")
    assert before[first : before.index("<!-- clocks -->")] in text


def test_a_benchmark_that_fails_says_why():
    with pytest.raises(RuntimeError, match="unrecognized arguments: --no-such-option"):
        run(Benchmark("positions", "--no-such-option"))


def test_a_benchmark_that_takes_too_long_is_stopped():
    with pytest.raises(RuntimeError, match=r"not done after 0\.001 minutes"):
        run(Benchmark("positions", "", 0.001))

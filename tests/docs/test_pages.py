"""The pages: generated parts are current, commands stand as promised, links lead somewhere."""

import re
from pathlib import Path

import polars as pl
import pytest
from generated import MADE_BY, PARTS, ROOT, code, orbit, output, part

from epipole.schemas.stages import Stage
from epipole.schemas.tables import TABLES

STALE = "`.ci/generate pages` writes it again"
PAGES = [p for where in ("*.md", "docs/**/*.md", "examples/*.md") for p in sorted(ROOT.glob(where))]
PAGE = pytest.mark.parametrize("page", PAGES, ids=[str(p.relative_to(ROOT)) for p in PAGES])


def links(page: Path) -> list[str]:
    """Return where the links of a page lead, other sites apart."""
    text = re.sub(r"```.*?```", "", page.read_text(), flags=re.DOTALL)
    targets = re.findall(r"\]\(([^)]+)\)", text)
    return [target for target in targets if "://" not in target]


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as public forges make them."""
    headings = re.findall(r"^#+ (.+)$", page.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", heading.lower()).replace(" ", "-") for heading in headings}


@pytest.mark.parametrize(
    ("page", "name"), [(page, name) for page, parts in PARTS.items() for name in parts]
)
def test_generated_parts_are_current(page, name):
    assert part((ROOT / page).read_text(), name) == PARTS[page][name](), STALE


def test_every_published_table_is_made_by_one_stage():
    made = [table for tables in MADE_BY.values() for table in tables]
    assert sorted(made) == sorted(TABLES)
    assert set(MADE_BY) <= set(Stage)


@pytest.mark.parametrize(
    "command",
    [
        "python -m pip install . && epipole run examples/four_sensor_geo.mcap --out out/",
        "python -m pip install '.[test]' && pytest -q",
    ],
)
def test_the_two_commands_stand_as_they_are(command):
    assert f"\n{command}\n" in (ROOT / "README.md").read_text()


def test_the_query_prints_what_the_readme_says(example):
    assert output(example) == part((ROOT / "README.md").read_text(), "output"), STALE


def test_the_fit_prints_what_its_page_says(example):
    said, found = part((ROOT / "docs" / "orbits.md").read_text(), "orbit"), orbit(example)
    number = r"-?\d+(?:\.\d+)?"
    assert re.sub(number, "", found).split() == re.sub(number, "", said).split(), STALE
    told, made = ([float(n) for n in re.findall(number, text)] for text in (said, found))
    assert made == pytest.approx(told, abs=0.003), (
        STALE
    )  # the last steps of a fit are its machine's


def test_the_arcs_of_the_page_about_orbits_are_found(example):
    names: dict = {}
    exec(code("docs/orbits.md", "read", f"{example}/out/"), names)
    arcs = names["arcs"]
    assert arcs["object_id"].n_unique() == 9
    assert arcs["magnitude"].is_between(5, 12).all()


def test_the_light_curve_of_the_page_about_orbits_is_of_one_geostationary_object(example):
    names: dict = {}
    exec(code("docs/orbits.md", "light", f"{example}/out/"), names)
    curve = names["light_curve"]
    assert len(curve) > 100
    assert curve["range_km"].is_between(35_000, 49_000).all()
    assert curve["phase_deg"].is_between(0, 180).all()
    assert curve["sunlit"].n_unique() == 1
    dimmer = curve["magnitude_1000_km"] + 5 * (curve["range_km"] / 1000).log(10)
    assert dimmer.is_between(5, 12).all()


def test_sql_finds_the_same_arcs_and_keeps_nanoseconds(example):
    by_polars, by_sql = {}, {}
    exec(code("docs/orbits.md", "read", f"{example}/out/"), by_polars)
    exec(code("docs/orbits.md", "duckdb", f"{example}/out/"), by_sql)
    rows = by_sql["arcs"].fetchall()
    assert [row[:3] for row in rows] == [row[:3] for row in by_polars["arcs"].iter_rows()]
    last = by_polars["observations"].collect()["time"].dt.epoch("ns").max()
    assert by_sql["observations"].aggregate("epoch_ns(max(time))").fetchall() == [(last,)]


def test_the_questions_have_answers(night_dataset):
    names: dict = {}
    exec(code("docs/tables.md", "questions", f"{night_dataset}/"), names)
    assert all(len(names[name]) for name in ("one_object", "came_near", "ten_minutes"))


def test_tables_join_by_their_keys_in_polars_and_in_sql(night_dataset):
    names: dict = {}
    exec(code("docs/tables.md", "join", f"{night_dataset}/"), names)
    seen = names["seen"]
    objects = pl.read_parquet(night_dataset / "night=*/objects/*.parquet")
    assert set(seen["object_id"]) == set(objects["object_id"])
    assert seen["rows"].sum() == objects["n_observations"].sum()
    assert (seen["direction_arcsec"] > seen["attitude_arcsec"]).all()
    text = code("docs/tables.md", "sql", f"{night_dataset}/")
    exec(text.replace("'out/", f"'{night_dataset}/"), names)
    rows = names["seen_by_sql"].fetchall()
    chosen = seen.select("object_id", "sensor_id", "verdict", "rows")
    assert [row[:4] for row in rows] == chosen.rows()


def test_nights_of_an_older_version_are_read_with_the_others(night_dataset, tmp_path):
    rows = pl.read_parquet(night_dataset / "night=*/objects/*.parquet", hive_partitioning=False)
    for night, gone in (("2019-03-31", ["name", "verdict"]), ("2019-04-01", [])):
        folder = tmp_path / "out" / f"night={night}" / "objects"
        folder.mkdir(parents=True)
        rows.drop(gone).write_parquet(folder / "part-0.parquet")
    names: dict = {}
    exec(code("docs/tables.md", "older", f"{tmp_path / 'out'}/"), names)
    found = names["objects"]
    assert len(found) == 2 * len(rows)
    assert found["verdict"].null_count() == len(rows)
    assert found["night"].n_unique() == 2


@PAGE
def test_links_lead_to_files_and_headings(page):
    for target in links(page):
        path, _, anchor = target.partition("#")
        file = (page.parent / path).resolve() if path else page
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), target


def test_every_page_can_be_reached_from_the_readme():
    reached, fresh = set(), {ROOT / "README.md"}
    while fresh:
        reached |= fresh
        targets = {
            (page.parent / target.partition("#")[0]).resolve()
            for page in fresh
            for target in links(page)
        }
        fresh = {target for target in targets if target.suffix == ".md"} - reached
    assert set(PAGES) <= reached


def test_paths_in_benchmark_commands_exist():
    text = (ROOT / "BENCHMARKS.md").read_text()
    for path in re.findall(r"(?:tests|tasks|io|flows|schemas)/[\w/]+\.py", text):
        assert (ROOT / path).exists(), path

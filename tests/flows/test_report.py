"""The report: as a command, at the end of a run, in a browser."""

import dataclasses
import json
import re
import shutil
import subprocess
import sys

import pytest
from scenes.dataset_tables import contents

from epipole.flows.night import reports
from epipole.flows.nightly import nightly
from epipole.flows.report import report
from epipole.io.datasets.dataset import check_folder, nights_in
from epipole.schemas.errors import DatasetError, ReportError
from epipole.schemas.settings import ReportSettings, Settings

NIGHT = "2019-04-01"
DRAWS = True
WITHOUT = Settings(report=ReportSettings(write=False))


def test_a_run_writes_the_report_beside_its_nights(night_dataset, tmp_path):
    written = night_dataset / "reports" / f"{NIGHT}.html"
    size = report(str(night_dataset), NIGHT, tmp_path / "sub" / "night.html")
    made = (tmp_path / "sub" / "night.html").read_bytes()
    assert size == len(made) < 1_000_000
    assert written.read_bytes() == made
    assert nights_in(night_dataset) == [NIGHT]
    assert sorted(p.name for p in (tmp_path / "sub").iterdir()) == ["night.html"]


def test_the_setting_changes_no_table(night_dataset, night_log, tmp_path):
    nightly([str(night_log)], str(tmp_path / "out"), settings=WITHOUT)
    assert not (tmp_path / "out" / "reports").exists()
    night = f"night={NIGHT}"
    assert contents(tmp_path / "out" / night) == contents(night_dataset / night)


def test_a_report_that_fails_is_a_warning_and_the_night_is_published(
    night_log, prefect, tmp_path, monkeypatch, caplog
):
    def broken(*_):
        raise RuntimeError("no\nlight")

    monkeypatch.setattr(reports, "night_facts", broken)
    summary = nightly([str(night_log)], str(tmp_path / "out"))
    assert summary.positions > 0
    assert summary.extracts == ()
    assert nights_in(tmp_path / "out") == [NIGHT]
    warnings = [r.getMessage() for r in caplog.records if r.levelname == "WARNING"]
    assert warnings == [f"the report of {NIGHT} could not be made: no light"]


def write_earlier_pages(dataset, nights):
    (dataset / "reports").mkdir()
    for night in nights:
        (dataset / "reports" / f"{night}.html").write_text("the night as it was before")


@pytest.mark.parametrize(
    "error", [ReportError("the report needs matplotlib"), AttributeError("of another version")]
)
def test_without_drawing_every_night_is_looked_at(night_run, tmp_path, monkeypatch, error):
    def missing():
        raise error

    dataset, summary = night_run
    nights = [NIGHT, "2019-04-02"]
    for night in nights:
        shutil.copytree(dataset / f"night={NIGHT}", tmp_path / f"night={night}")
    summary = dataclasses.replace(summary, dataset=str(tmp_path), nights=nights)
    monkeypatch.setattr(reports, "_drawing", missing)
    reports.load_drawing()  # before a run: it goes on
    write_earlier_pages(tmp_path, [*nights, "2019-03-31"])
    made = reports.with_reports(summary, dict.fromkeys(nights, tmp_path / "none"), write=True)
    assert [page.name for page in (tmp_path / "reports").iterdir()] == ["2019-03-31.html"]
    assert sorted(made.looks) == nights
    assert made.extracts == ()


def test_an_earlier_report_that_cannot_be_removed_hides_no_look(night_run, tmp_path, monkeypatch):
    def failing(*_):
        raise DatasetError("connection lost")

    dataset, summary = night_run
    shutil.copytree(dataset / f"night={NIGHT}", tmp_path / f"night={NIGHT}")
    summary = dataclasses.replace(summary, dataset=str(tmp_path))
    monkeypatch.setattr(reports, "remove_beside", failing)
    made = reports.with_reports(summary, {NIGHT: tmp_path / "none"}, write=False)
    assert sorted(made.looks) == [NIGHT]


def test_a_report_that_fails_stops_no_other(night_run, tmp_path, monkeypatch):
    dataset, summary = night_run
    nights = [NIGHT, "2019-04-02", "2019-04-03"]
    for night in nights:
        shutil.copytree(dataset / f"night={NIGHT}", tmp_path / f"night={night}")
    facts_of, draw = reports.night_facts, reports._page_and_extract

    def facts(dataset, night, *others):
        if night == nights[0]:
            raise DatasetError("no facts")
        return facts_of(dataset, night, *others)

    def drawn(facts):
        if facts.night == nights[1]:
            raise RuntimeError("no light")
        return draw(facts)

    monkeypatch.setattr(reports, "night_facts", facts)
    monkeypatch.setattr(reports, "_page_and_extract", drawn)
    write_earlier_pages(tmp_path, nights)
    summary = dataclasses.replace(summary, dataset=str(tmp_path), nights=nights)
    made = reports.with_reports(summary, dict.fromkeys(nights, tmp_path / "none"), write=True)
    assert sorted(made.looks) == nights[1:]
    assert [path.name for path in (tmp_path / "reports").iterdir()] == [f"{nights[2]}.html"]


def without_matplotlib(code, *arguments):
    hidden = f"import sys; sys.modules['matplotlib'] = None; {code}"
    return subprocess.run(
        [sys.executable, "-c", hidden, *arguments], capture_output=True, text=True, check=False
    )


def test_without_matplotlib_one_line_says_which_extra_to_install(night_dataset, tmp_path):
    code = "from epipole.flows.command_line.main import main; main()"
    out = tmp_path / "night.html"
    told = without_matplotlib(code, "report", str(night_dataset), "--night", NIGHT,
                              "--out", str(out))  # fmt: skip
    assert told.returncode == 1
    assert told.stderr.count("\n") == 1
    assert "epipole[report]" in told.stderr
    assert not out.exists()


@pytest.mark.long
def test_without_matplotlib_a_run_goes_on():
    told = without_matplotlib("import epipole.flows.nightly, epipole.flows.prefect.artifacts")
    assert told.returncode == 0, told.stderr


def test_bad_input_is_one_error(night_dataset, tmp_path):
    with pytest.raises(DatasetError, match="has no night 2019-04-02"):
        report(str(night_dataset), "2019-04-02", tmp_path / "a.html")
    with pytest.raises(ReportError, match="is a folder"):
        report(str(night_dataset), NIGHT, tmp_path)
    (tmp_path / "file").touch()
    with pytest.raises(ReportError, match="cannot be written"):
        report(str(night_dataset), NIGHT, tmp_path / "file" / "a.html")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_table_that_cannot_be_read_is_named(night_dataset, tmp_path):
    broken = tmp_path / "out"
    shutil.copytree(night_dataset, broken)
    (broken / f"night={NIGHT}" / "stars" / "part-0.parquet").write_bytes(b"no parquet")
    with pytest.raises(DatasetError, match="stars: cannot be read"):
        report(str(broken), NIGHT, tmp_path / "a.html")


def test_a_dataset_of_which_only_reports_are_left_is_one(night_dataset, tmp_path):
    (tmp_path / "reports").mkdir()
    check_folder(tmp_path)


@pytest.mark.long
def test_in_an_object_store_the_report_is_the_same(s3, night_log, prefect, night_dataset, tmp_path):
    out = "s3://nights/reported"
    nightly([str(night_log)], out)
    stored = s3.cat_file(f"nights/reported/reports/{NIGHT}.html").decode()
    local = (night_dataset / "reports" / f"{NIGHT}.html").read_text()
    assert stored.replace(out, "OUT") == local.replace(str(night_dataset), "OUT")
    for name in ("a.html", "b.html"):
        report(out, NIGHT, tmp_path / name)
        assert (tmp_path / name).read_text() == stored
    report(out, None, tmp_path / "nights.html")
    page = (tmp_path / "nights.html").read_text()
    assert '<span class="night good"' in page  # as its page says; a browser cannot go to s3://
    assert "s3://nights/reported/reports" not in page


def test_the_trend_is_of_the_nights_before(night_dataset, tmp_path):
    dataset = tmp_path / "out"
    for night in ("2019-03-30", "2019-03-31", "2019-04-01", "2019-04-02"):
        shutil.copytree(night_dataset / f"night={NIGHT}", dataset / f"night={night}")
    report(str(dataset), NIGHT, tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text()
    assert "of 3 nights" in page
    assert "2019-04-02" not in page


def test_without_a_night_it_is_a_calendar_with_links_to_their_pages(night_dataset, tmp_path):
    dataset = tmp_path / "out"
    for night in (NIGHT, "2019-04-02"):
        shutil.copytree(night_dataset / f"night={NIGHT}", dataset / f"night={night}")
    shutil.copytree(night_dataset / "reports", dataset / "reports")
    (dataset / "night=2019-04-03" / "nights").mkdir(parents=True)
    (dataset / "night=2019-04-03" / "nights" / "part-0.parquet").write_bytes(b"no parquet")
    report(str(dataset), None, tmp_path / "pages" / "nights.html")
    page = (tmp_path / "pages" / "nights.html").read_text()
    (link,) = re.findall(r'<a class="night good"[^>]*href="([^"]*)"', page)
    assert (tmp_path / "pages" / link).resolve() == dataset / "reports" / f"{NIGHT}.html"
    assert '<span class="night good counted"' in page
    assert "2019-04-03: its table `nights` is missing or cannot be read" in page
    with pytest.raises(DatasetError, match="has no night"):
        report(str(tmp_path / "none"), None, tmp_path / "a.html")


CHROMIUM = shutil.which("chromium")
# Adds to the page what a browser can say of it: its width, its pictures, and what keys do.
PROBE = """<script>addEventListener("load", () => {
const pictures = [...document.querySelectorAll("svg.plot")].filter(p => !p.closest("details"));
const press = (svg, ...keys) => keys.forEach(key =>
  svg.dispatchEvent(new KeyboardEvent("keydown", {key})));
const says = () => document.getElementById("tip").textContent;
const [frame, sky] = ["frame", "sky"].map(id => document.querySelector(`#${id} svg.plot`));
press(frame, "ArrowRight", "ArrowLeft"); const star = says();
press(frame, "+", "+"); const zoomed = frame.classList.contains("zoomed");
const ticks = frame.querySelectorAll(".own text").length;
press(frame, "0"); const whole = !frame.classList.contains("zoomed");
press(sky, "ArrowRight", "Enter"); dispatchEvent(new HashChangeEvent("hashchange"));
document.title = JSON.stringify({star, zoomed, ticks, whole,
opened: document.querySelectorAll("details[open]").length,
wide: document.documentElement.scrollWidth - innerWidth,
inner: innerWidth, drawn: pictures.filter(p => p.getBoundingClientRect().height > 50).length,
pictures: pictures.length, fetched: performance.getEntriesByType("resource")
  .filter(e => !e.name.startsWith("data:")).length}); })</script></body>"""


def browse(page, folder, width):
    """Return what the browser says of a page, and its console."""
    # A page may not be narrower than 500 px in a window: a frame in it may.
    inner = page.replace("</body>", PROBE)
    inner = re.sub(r"script-src 'sha256-[^']*'", "script-src 'unsafe-inline'", inner)
    (folder / "page.html").write_text(inner)
    (folder / "frame.html").write_text(
        f'<iframe id=f src="page.html" style="width:{width}px;height:800px;border:0"></iframe>'
        "<script>f.onload = () => setTimeout(() => "
        "{document.title = f.contentDocument.title}, 50)</script>"
    )
    told = subprocess.run(
        [CHROMIUM, "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
         "--no-first-run", "--disable-background-networking", "--disable-component-update",
         "--disable-sync", f"--user-data-dir={folder / 'profile'}", "--enable-logging=stderr",
         "--allow-file-access-from-files", "--virtual-time-budget=5000", "--window-size=1300,900",
         "--dump-dom", (folder / "frame.html").as_uri()],
        capture_output=True, text=True, timeout=120, check=True,
    )  # fmt: skip
    title = told.stdout.partition("<title>")[2].partition("</title>")[0]
    console = [line for line in told.stderr.splitlines() if "CONSOLE" in line]
    return json.loads(title), console


@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
@pytest.mark.parametrize("width", [360, 1200])
def test_a_browser_shows_all_of_it_without_scrolling_sideways(night_dataset, tmp_path, width):
    page = (night_dataset / "reports" / f"{NIGHT}.html").read_text()
    seen, console = browse(page, tmp_path, width)
    assert seen["inner"] == width
    assert seen["wide"] <= 0
    assert seen["drawn"] == seen["pictures"] >= 12
    assert seen["star"].startswith("star ")
    assert seen["zoomed"]
    assert seen["ticks"] >= 4
    assert seen["whole"]
    assert seen["opened"] == 1
    assert seen["fetched"] == 0
    assert console == []

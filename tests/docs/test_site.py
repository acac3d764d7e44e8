"""The site: it is built without warnings, and all of its links lead somewhere."""

import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import pytest
from generated import ROOT

from epipole.flows import api

pytestmark = pytest.mark.long

for package in ("sphinx", "furo", "myst_parser", "numpydoc", "matplotlib"):
    pytest.importorskip(package, reason=f"{package} is of the group docs")

BUILD = ROOT / "docs" / "site" / "build.py"
OUTSIDE = ("http://", "https://", "mailto:", "data:")


class Page(HTMLParser):
    """The links and the anchors of a page, and what it loads from elsewhere."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.links: set[str] = set()
        self.anchors: set[str] = set()
        self.loaded: set[str] = set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name == "id" and value:
                self.anchors.add(value)
            elif name in ("href", "src") and value:
                (self.links if tag == "a" else self.loaded).add(value)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """Return the folder of the built site."""
    folder = tmp_path_factory.mktemp("site")
    made = subprocess.run(
        [sys.executable, BUILD, folder], capture_output=True, text=True, check=False
    )
    assert made.returncode == 0, made.stderr
    return folder / "html"


@pytest.fixture(scope="module")
def pages(site) -> dict[Path, Page]:
    """Return all pages of the site."""
    return {path: Page(path) for path in site.rglob("*.html")}


def test_every_page_of_the_repository_is_on_the_site(site):
    assert len(list(site.rglob("*.html"))) >= len(list((ROOT / "docs").rglob("*.md")))
    for page in (ROOT / "docs").rglob("*.md"):
        if page.name != "README.md":
            made = site / page.relative_to(ROOT / "docs").with_suffix(".html")
            assert made.exists(), page


def test_every_link_leads_to_a_page_and_an_anchor(pages):
    for path, page in pages.items():
        for link in page.links:
            if link.startswith(OUTSIDE):
                continue
            where, _, anchor = unquote(link).partition("#")
            target = (path.parent / where).resolve() if where else path
            assert target.exists(), f"{path.name}: {link}"
            if anchor and target.suffix == ".html":
                assert anchor in pages[target].anchors, f"{path.name}: {link}"


def test_pages_load_nothing_from_the_web(pages):
    for path, page in pages.items():
        for source in page.loaded:
            if not source.startswith("data:"):
                assert not source.startswith(OUTSIDE), f"{path.name}: {source}"
                where = source.partition("?")[0].partition("#")[0]
                assert (path.parent / where).exists(), f"{path.name}: {source}"


def test_every_page_is_in_the_navigation(site, pages):
    index = pages[site / "index.html"]
    found = {(site / link.partition("#")[0]).resolve() for link in index.links}
    others = {"index.html", "search.html", "genindex.html", "py-modindex.html"}
    assert {path for path in pages if path.name not in others} <= found


def test_the_public_names_have_their_docstrings(pages, site):
    anchors = pages[site / "api.html"].anchors
    for name in api.__all__:
        assert name == "__version__" or f"epipole.flows.api.{name}" in anchors, name


def test_formulas_are_drawn(site):
    page = (site / "methods" / "positions.html").read_text(encoding="utf-8")
    assert page.count('class="formula display"') == 2
    assert "$" not in re.sub(r"<pre>.*?</pre>|aria-label=.*?>", "", page, flags=re.DOTALL)

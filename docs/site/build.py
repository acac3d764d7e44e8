"""Build the documentation site from the Markdown pages.

    python docs/site/build.py [FOLDER]       # build/site if none is named; see FOLDER/html

The pages are those that are read in the repository. They are collected into FOLDER/source: links
between pages are kept, links to code lose their target, because the site has no code. Sphinx then
makes FOLDER/html from them; a warning is an error.
"""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[1]

# The order of the pages. What lies in docs/ and is not named here comes at the end of "Use".
SECTIONS = {
    "Start": ("docs/first_night.md", "examples/README.md"),
    "Use": (
        "docs/operations.md", "docs/commands.md", "docs/input.md", "docs/tables.md",
        "docs/orbits.md", "docs/overlay.md", "docs/api.md", "docs/settings.md", "docs/scaling.md",
        "docs/scenes.md",
    ),
    "Concepts": (
        "docs/conventions.md", "docs/glossary.md", "docs/methods/identification.md",
        "docs/methods/passes.md", "docs/methods/optics.md", "docs/methods/tracking.md",
        "docs/methods/association.md", "docs/methods/positions.md", "docs/methods/orbits.md",
        "docs/methods/linking.md", "docs/methods/names.md", "docs/methods/sensors.md",
        "docs/methods/boresight.md",
    ),
    "How good": ("docs/limits.md", "docs/damage.md", "BENCHMARKS.md"),
    "Project": ("docs/README.md", "CONTRIBUTING.md", "SECURITY.md", "CHANGELOG.md"),
}  # fmt: skip
RENAMED = {
    "README.md": "index.md",
    "docs/README.md": "pages.md",
    "docs": "pages.md",
    "examples/README.md": "example.md",
    "BENCHMARKS.md": "benchmarks.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "SECURITY.md": "security.md",
}
TITLES = {"docs/README.md": "All pages"}  # in the navigation, where the heading says too little
OFFERED = ("examples/*.py", "prefect.yaml")  # files that can be downloaded from the site
PICTURE_SCALE = 0.68  # pictures have 180 dots an inch, screens 96
LINK = re.compile(r"(!?\[(?:[^\[\]]|\[[^\]]*\])*\])\(([^()\s]+)\)")


def sections() -> dict[str, list[str]]:
    """Return the pages of each section, from the root of the repository."""
    found = {name: list(pages) for name, pages in SECTIONS.items()}
    named = {page for pages in found.values() for page in pages}
    others = (p.relative_to(ROOT).as_posix() for p in sorted((ROOT / "docs").rglob("*.md")))
    found["Use"] += [page for page in others if page not in named]
    return found


def place(path: str) -> str:
    """Return where a page or picture of the repository lies in the site's source."""
    return RENAMED.get(path, path.removeprefix("docs/"))


def collect(source: Path) -> None:
    """Write the pages, pictures and files that the site is made of."""
    pages = ["README.md", *(page for listed in sections().values() for page in listed)]
    offered = [p.relative_to(ROOT).as_posix() for where in OFFERED for p in ROOT.glob(where)]
    for page in pages:
        text = _linked(page, set(pages), set(offered))
        if page == "README.md":
            text += "".join(_contents(name, listed) for name, listed in sections().items())
        if page == "docs/api.md":
            text += _docstrings()
        _write(source / place(page), text.encode())
    pictures = (ROOT / "docs" / "pictures").glob("*.png")
    for path in [*offered, *(p.relative_to(ROOT).as_posix() for p in pictures)]:
        _write(source / place(path), (ROOT / path).read_bytes())


def _linked(page: str, pages: set[str], offered: set[str]) -> str:
    """Return the text of a page with the links that it has on the site."""

    def link(match: re.Match[str]) -> str:
        label, target = match.groups()
        path, hash_, anchor = target.partition("#")
        if "://" in target or not path:
            return match[0]
        there = (ROOT / page).parent.joinpath(path).resolve().relative_to(ROOT).as_posix()
        if there in pages | offered or there in RENAMED or label.startswith("!"):
            away = os.path.relpath(place(there), Path(place(page)).parent)
            size = _size(ROOT / there) if label.startswith("!") else ""
            return f"{label}({away}{hash_}{anchor}){size}"
        name = label[1:-1]
        return f"`{name}`" if re.fullmatch(r"[\w./]+", name) else name

    return outside_code((ROOT / page).read_text(encoding="utf-8"), lambda t: LINK.sub(link, t))


def _size(picture: Path) -> str:
    """Return the width of a PNG as an attribute: its letters are then as large as small text."""
    width_px = int.from_bytes(picture.read_bytes()[16:20], "big")
    return f"{{width={round(width_px * PICTURE_SCALE)}px}}"


def outside_code(text: str, change: Callable[[str], str]) -> str:
    """Return a page in which what is no block of code has been changed."""
    parts = re.split(r"(^ *```.*?^ *```$)", text, flags=re.DOTALL | re.MULTILINE)
    return "".join(part if k % 2 else change(part) for k, part in enumerate(parts))


def _contents(name: str, pages: list[str]) -> str:
    lines = [
        f"{TITLES[page]} <{place(page).removesuffix('.md')}>"
        if page in TITLES
        else place(page).removesuffix(".md")
        for page in pages
    ]
    return "\n\n```{toctree}\n:hidden:\n:caption: " + "\n".join([name, "", *lines]) + "\n```\n"


def _docstrings() -> str:
    """Return the directives that print the docstrings of the public names."""
    from epipole.flows import api

    kinds = [
        (name, "autoclass" if isinstance(getattr(api, name), type) else "autofunction")
        for name in sorted(api.__all__, key=lambda name: (name[0].isupper(), name))
        if name != "__version__"
    ]
    lines = [f".. {kind}:: epipole.flows.api.{name}\n" for name, kind in kinds]
    return "\n\n## All docstrings\n\n```{eval-rst}\n" + "\n".join(lines) + "```\n"


def _write(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def build(folder: Path) -> None:
    """Make the site in FOLDER/html.

    Raises
    ------
    subprocess.CalledProcessError
        Where Sphinx has a warning; it says which.
    """
    for made in ("source", "doctrees", "html"):
        shutil.rmtree(folder / made, ignore_errors=True)
    collect(folder / "source")
    command = [sys.executable, "-m", "sphinx", "--builder", "html", "--fail-on-warning",
               "--quiet", "--conf-dir", HERE, "--doctree-dir", folder / "doctrees",
               folder / "source", folder / "html"]  # fmt: skip
    subprocess.run(command, check=True)


if __name__ == "__main__":
    target = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "build" / "site"
    build(target)
    print(f"{target / 'html' / 'index.html'}")

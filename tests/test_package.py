"""The package: what is in the source distribution and the wheel, and what an index shows."""

import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from email.parser import Parser
from pathlib import Path

import pytest

from epipole.io.caches.kernel_list import read_kernels
from epipole.io.caches.kernel_target import common_target
from epipole.io.caches.kernels import HANDED_ON

pytest.importorskip("build", reason="build is of the group dev")
pytest.importorskip("setuptools_scm", reason="setuptools-scm is of the group dev")

ROOT = Path(__file__).parents[1]
KERNELS = "epipole/io/caches/compiled/"
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT = PYPROJECT["project"]
LEFT_OUT = shutil.ignore_patterns(
    ".git", ".venv", "build", "dist", "out", "*.egg-info", "__pycache__", ".*_cache", ".hypothesis"
)


@pytest.fixture(scope="module")
def tree(tmp_path_factory) -> Path:
    """Return a copy of the repository: to build leaves files in it."""
    if int(importlib.metadata.version("setuptools").partition(".")[0]) < 77:
        pytest.skip("setuptools 77 or later is of the group dev")
    return Path(shutil.copytree(ROOT, tmp_path_factory.mktemp("tree") / "tree", ignore=LEFT_OUT))


@pytest.fixture(scope="module")
def dist(tree) -> Path:
    """Return a folder with the source distribution, and the wheel that was built from it."""
    files = tree.with_name("dist")
    command = [sys.executable, "-m", "build", "--no-isolation", "--outdir", files, tree]
    made = subprocess.run(command, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    return files


def packed(dist: Path) -> set[str]:
    with tarfile.open(next(dist.glob("*.tar.gz"))) as archive:
        return {m.name.partition("/")[2] for m in archive.getmembers() if m.isfile()}


def test_the_source_distribution_has_the_whole_repository(tree, dist):
    folders = (".ci", "docs", "examples", "tests", "schemas", "io", "tasks", "flows")
    files = [p for folder in folders for p in (tree / folder).rglob("*") if p.is_file()]
    files += [*tree.glob("*.md"), *tree.glob("*.toml"), *tree.glob("*.yaml"), tree / "LICENSE"]
    files += [tree / "CITATION.cff", tree / "constraints.txt"]
    wanted = {p.relative_to(tree).as_posix() for p in files}
    assert wanted - packed(dist) == set()
    for name in ("examples/four_sensor_geo.mcap", "docs/first_night.md", "tests/conftest.py"):
        assert name in packed(dist)


def test_the_wheel_has_all_modules_and_their_data_and_nothing_else(dist):
    with zipfile.ZipFile(next(dist.glob("*.whl"))) as wheel:
        names = {n for n in wheel.namelist() if ".dist-info/" not in n and KERNELS not in n}
    homes = ("schemas", "io", "tasks", "flows")
    files = (p for home in homes for p in (ROOT / home).rglob("*") if p.is_file())
    wanted = {f"epipole/{p.relative_to(ROOT).as_posix()}" for p in files if p.suffix != ".pyc"}
    assert names == wanted


def test_the_wheel_has_kernels_that_serve_elsewhere(dist, tmp_path):
    if common_target() is None:
        pytest.skip("wheels have kernels for x86-64 processors of level 3 only")
    (wheel,) = dist.glob("*-cp3*-linux_x86_64.whl")
    with zipfile.ZipFile(wheel) as packed:
        packed.extractall(tmp_path / "other")
    environment = os.environ | {"PYTHONPATH": str(tmp_path / "other"), HANDED_ON: ""}
    environment |= {"EPIPOLE_CACHE": str(tmp_path / "cache"), "NUMBA_CACHE_DIR": ""}
    code = "from epipole.flows.command_line.main import main; main()"
    log = ROOT / "examples" / "four_sensor_geo.mcap"
    said = subprocess.run(
        [sys.executable, "-c", code, "info", log], env=environment, cwd=tmp_path, check=True,
        capture_output=True, text=True,
    )  # fmt: skip
    assert said.stderr == ""  # else: compiling
    kept = tmp_path / "cache" / "kernels"
    files = {p.relative_to(kept) for p in kept.rglob("*") if p.is_file()}
    shipped = tmp_path / "other" / KERNELS
    assert files == {p.relative_to(shipped) for p in shipped.rglob("*") if p.is_file()}
    assert len(files) > 2 * len(read_kernels())  # an index and the code of each


def metadata(dist: Path):
    with zipfile.ZipFile(next(dist.glob("*.whl"))) as wheel:
        name = next(n for n in wheel.namelist() if n.endswith(".dist-info/METADATA"))
        return Parser().parsestr(wheel.read(name).decode())


def test_an_index_shows_the_readme_without_dead_links(dist):
    text = metadata(dist).get_payload()
    assert text.lstrip().startswith("# epipole")
    prose = re.sub(r"```.*?```", "", text, flags=re.DOTALL)
    assert re.findall(r"\]\((?!https?://)", prose) == []
    assert "![" not in prose
    assert "<!--" not in text
    readme = (ROOT / "README.md").read_text()
    for heading in re.findall(r"^## .+$", readme, re.MULTILINE):
        assert heading in text
    assert "(`docs/orbits.md`)" in text


def test_the_metadata_are_complete(dist):
    found = metadata(dist)
    assert found["Author"] in (ROOT / "LICENSE").read_text()
    assert found["License-Expression"] == "MIT"
    assert found.get_all("Classifier") == PROJECT["classifiers"]


def test_a_tree_without_git_has_the_fallback_version(tree, dist):
    fallback = PYPROJECT["tool"]["setuptools_scm"]["fallback_version"]
    of_tree = tree / "PKG-INFO"  # this copy may be of a source distribution
    wanted = Parser().parsestr(of_tree.read_text())["Version"] if of_tree.exists() else fallback
    assert metadata(dist)["Version"] == wanted
    assert (dist / f"epipole-{wanted}.tar.gz").exists()


def test_a_checkout_has_the_version_of_its_tag(tmp_path):
    if shutil.which("git") is None:
        pytest.skip("git is not installed")
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    git = ("git", "-C", tmp_path, "-c", "user.name=a", "-c", "user.email=a@b")
    for command in (("init", "-q"), ("add", "."), ("commit", "-qm", "All"), ("tag", "v2.3.4")):
        subprocess.run([*git, *command], check=True, capture_output=True)
    command = [sys.executable, "-m", "setuptools_scm"]
    said = subprocess.run(command, cwd=tmp_path, check=True, capture_output=True, text=True).stdout
    assert said.strip() == "2.3.4"


def test_the_group_test_is_the_extra_test():
    """The README's second command takes the extra: groups need a newer pip."""
    assert PYPROJECT["dependency-groups"]["test"] == PROJECT["optional-dependencies"]["test"]


def test_twine_finds_nothing_wrong(dist):
    pytest.importorskip("twine", reason="twine is of no group: it is needed to upload only")
    files = [*dist.glob("*.tar.gz"), *dist.glob("*.whl")]
    command = [sys.executable, "-m", "twine", "check", "--strict", *files]
    subprocess.run(command, check=True, capture_output=True)

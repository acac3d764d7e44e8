"""The pages' blocks of commands run as they are pasted, in their order."""

import os
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from generated import ROOT

BLOCK = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)
COMMANDS = ("epipole ", "python ", "pip ", "set ", ".ci/")
RUN = (
    "examples/README.md", "docs/first_night.md", "docs/orbits.md", "docs/overlay.md",
    "docs/report.md", "docs/operations.md",
)  # fmt: skip
ELSEWHERE = {
    "README.md": "`.ci/run` runs the two commands in a bare environment",
    "CONTRIBUTING.md": "`.ci/run` begins with it",
    "docs/commands.md": "an overview, in which words stand for what is given",
}
# The commands of a deployment: tests/flows/test_deployment.py runs them.
DEPLOYED = "epipole deploy-files"
INSTALLS = re.compile(r"^(python -m )?(pip|venv) .*\n", re.MULTILINE)


def blocks(page: str) -> list[str]:
    found = BLOCK.findall((ROOT / page).read_text())
    return [block for language, block in found if not language and block.startswith(COMMANDS)]


def test_every_page_with_commands_is_run_or_says_where_else():
    pages = [path.relative_to(ROOT).as_posix() for path in ROOT.glob("**/*.md")
             if not path.relative_to(ROOT).parts[0].startswith(".")]  # fmt: skip
    assert {page for page in pages if blocks(page)} == {*RUN, *ELSEWHERE}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Return a folder with the examples, and with a folder of logs."""
    (tmp_path / "examples").symlink_to(ROOT / "examples")
    (tmp_path / "data" / "logs").mkdir(parents=True)
    log = ROOT / "examples" / "four_sensor_geo.mcap"
    (tmp_path / "data" / "logs" / log.name).symlink_to(log)
    return tmp_path


def pasted(block: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a block. What it installs is there; /data is in the folder."""
    text = INSTALLS.sub("", block).replace(" /data/", f" {folder}/data/")
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    return subprocess.run(
        ["bash", "-euc", text], cwd=folder, capture_output=True, text=True,
        env=os.environ | {"PATH": path},
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("page", RUN)
def test_the_commands_of_a_page_run(page, folder, example):
    if not any("epipole run examples/" in block for block in blocks(page)):
        shutil.copytree(example / "out", folder / "out")
    for block in blocks(page):
        if block.startswith(DEPLOYED) or ("orekit" in block and find_spec("orekit_jpype") is None):
            continue
        ended = pasted(block, folder)
        assert ended.returncode == 0, f"{block}\n{ended.stdout}\n{ended.stderr}"
        assert "Traceback" not in ended.stderr

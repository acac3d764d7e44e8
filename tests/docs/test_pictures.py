"""The pictures: the script draws all that the pages show, and they stay small."""

import subprocess
import sys

import pytest
from generated import ROOT

pytestmark = pytest.mark.long

PICTURES = ROOT / "docs" / "pictures"


def test_the_script_draws_the_pictures_that_are_kept(example, tmp_path):
    pytest.importorskip("matplotlib")
    script = PICTURES / "make.py"
    subprocess.run([sys.executable, script, example / "out", tmp_path], check=True, cwd=tmp_path)
    assert {p.name for p in tmp_path.glob("*.png")} == {p.name for p in PICTURES.glob("*.png")}


def test_the_pictures_are_small():
    assert 0 < sum(picture.stat().st_size for picture in PICTURES.glob("*.png")) < 350_000

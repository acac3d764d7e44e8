"""Every benchmark runs: each on one tiny round, so that none is outdated unnoticed."""

import csv
import importlib
import logging
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from epipole.tasks.algorithms.geometry.camera import Camera, inside, project
from epipole.tasks.algorithms.geometry.directions import matrix_from_quaternion

pytestmark = pytest.mark.long

HERE = Path(__file__).parent
BUILT_IN = HERE.parents[1] / "io" / "simulation" / "built_in"
ORBITS = f"--low {BUILT_IN}/real_leo.tle {BUILT_IN}/real_sensors.tle --geo {BUILT_IN}/real_geo.tle"

# The arguments of a round, {folder} an empty folder.
TINY = {
    "alignment": "--seeds 1 --seconds 20",
    "association": "points openptv tracklets --seeds 1 --false 10",
    "catalogue": "build --repeats 1 --only hipparcos",
    "clocks": "--offsets 0.1",
    "crowded_frames": "--cameras b --false 40 --cluster 0 --frames 2",
    "epipolar": "--scenes 2",
    "example": "--rounds 1 --cached --only `",
    "false_alarms": "followed alone --frames 20 --points 3 9 --every 3",
    "hostile_logs": "bursts --fields 20 --frames 3 --flux yes",
    "identity": "--gaps 120 --seeds 1",
    "ingest": "--frames 400 --runs 1",
    "known_objects": "--objects 6 --ages 3 --catalogue 60",
    "long_evidence": "--seeds 1 --lone 2 --minutes 0.5 --longest 600",
    "many_sensors": "ring --sensors 8",
    "mistakes": "--kinds geo --seconds 20 --only m/s --out {folder}",
    "night": "--shares 1 --hours 0.02",
    "orbit_fits": "--seeds 1",
    "orbit_linking": "--satellites 20 --hours 0.03",
    "page": "--rounds 1",
    "passages": "--satellites 2 --seeds 1 --seconds 20",
    "photographs": "{folder}/list.csv --width 1024 --height 1024 --field 20 --year 2024 --reach 0",
    "pooled_scenes": "--first 13 --scenes 1 --unlike --out {folder}",
    "positions": "--positions 20",
    "queries": "--nights 10 --rows 1000 --runs 1",
    "real_orbits": f"{ORBITS} --first 4 --scenes 1 --out {{folder}}",
    "scaling": "--sensors 2 --hours 0.01 --objects 5",
    "scenes": "--scenes lost_in_space",
    "simulation": "--hours 0.1 --sensors 2",
    "star_identification": "--made 3 --cameras c --tracked 200",
    "track_linking": "--seeds 1",
    "tracking": "--frames 20 --objects 10 --false 2 --repeats 1",
    "unlike_frames": "--cameras a --kinds shaken errors --frames 8",
    "unknown_cameras": "--frames 1 --told 1.02 --fields 12",
    "untold_optics": "--tiny --place drawn --frames 30",
}
# Rounds with other tools, of packages that CI does not install.
WITH_PACKAGES = {
    ("orekit_orbits", "orekit_jpype"): "",
    ("epipolar", "matplotlib"): "--scenes 2 --out {folder}",
    ("track_linking", "laptrack"): "--seeds 1 --rivals",
}


@pytest.fixture
def play(monkeypatch, tmp_path, prefect):
    """Yield a function that runs a benchmark of this name with these arguments."""
    from prefect.settings import get_current_settings

    api = get_current_settings().api  # one for all their processes
    monkeypatch.setenv("PREFECT_API_URL", api.url)
    monkeypatch.setenv("PREFECT_API_AUTH_STRING", api.auth_string.get_secret_value())
    for name in ("EPIPOLE_CACHE", "PREFECT_HOME"):  # benchmarks may change these
        monkeypatch.setenv(name, os.environ[name])
    monkeypatch.syspath_prepend(HERE)

    def run(name: str, arguments: str) -> None:
        given = arguments.format(folder=tmp_path).split()
        monkeypatch.setattr(sys, "argv", [f"bench_{name}.py", *given])
        importlib.import_module(f"bench_{name}").main()

    logger = logging.getLogger("epipole")
    level = logger.level
    yield run
    logging.disable(logging.NOTSET)  # benchmarks may be quieter than tests
    logger.setLevel(level)


def write_list(path: Path) -> None:
    """Write the brighter Hipparcos stars in a pinhole camera's image, with their numbers."""
    from star_frames import hipparcos_at_epoch

    camera = Camera(1024, 1024, *[512 / np.tan(np.radians(10))] * 2, 511.5, 511.5)
    R = matrix_from_quaternion(np.array([[0.1, 0.5, -0.3, 0.8]]))[0]
    stars = hipparcos_at_epoch(5.5)
    v = stars.u_icrs @ R.T
    x, y = project(camera, v)
    rows = np.flatnonzero((v[:, 2] > 0) & inside(camera, x, y))
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["x_px", "y_px", "star_id"])
        writer.writerows((x[k], y[k], stars.star_id[k]) for k in rows)


def test_the_table_names_every_benchmark():
    named = {*TINY, *(name for name, _ in WITH_PACKAGES)}
    assert sorted(named) == sorted(path.stem[len("bench_") :] for path in HERE.glob("bench_*.py"))


@pytest.mark.parametrize("name", TINY)
def test_a_tiny_round_ends(name, play, tmp_path, capsys):
    if name == "photographs":
        write_list(tmp_path / "list.csv")
    play(name, TINY[name])
    said = capsys.readouterr().out
    assert said
    if name == "photographs":
        assert "0 of 1 focal lengths refused" in said


@pytest.mark.parametrize(("name", "package"), WITH_PACKAGES)
def test_a_tiny_round_with_other_packages_ends(name, package, play):
    pytest.importorskip(package, reason=f"{package} is of an extra or a group")
    play(name, WITH_PACKAGES[name, package])

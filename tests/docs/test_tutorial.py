"""The tutorial and the page for notebooks: their code runs, and prints what they say."""

import re
from typing import NamedTuple

import numpy as np
import polars as pl
import pytest
from generated import ROOT, TUTORIAL, with_outputs

from epipole.flows import api
from epipole.flows.simulate import simulate
from epipole.io.simulation.scenes import read_scene
from epipole.io.simulation.truth import elements_of, read_truth
from epipole.tasks.algorithms.simulation.paths import state_at


class Sensor(NamedTuple):
    """What the page's code takes of a sensor."""

    x_px: np.ndarray
    y_px: np.ndarray
    flux: np.ndarray
    camera: api.Camera
    time: object
    r_km: list[float]
    v_km_s: list[float]


def test_the_tutorial_prints_what_it_says(example, monkeypatch):
    pytest.importorskip("matplotlib", reason="matplotlib is of the group docs")
    monkeypatch.setenv("MPLBACKEND", "agg")
    said = (ROOT / TUTORIAL).read_text()
    assert with_outputs(said, example) == said, "`.ci/generate pages` writes it again"


def test_the_commands_of_the_tutorial_are_those_of_the_other_pages():
    said, readme = ((ROOT / page).read_text() for page in (TUTORIAL, "README.md"))
    assert "epipole run examples/four_sensor_geo.mcap --out out/\n" in said
    assert "epipole run examples/four_sensor_geo.mcap --out out/\n" in readme
    for command in re.findall(r"^(?:python|epipole) .*examples/\S+", said, re.MULTILINE):
        where = re.search(r"examples/\S+", command)[0]
        assert (ROOT / where).exists(), command


@pytest.fixture(scope="module")
def one_instant(tmp_path_factory):
    """Return the sensors at the first common exposure of a log, and the objects' places then."""
    scene = read_scene("four_sensor_geo")
    sensors = [sensor.model_copy(update={"phase": 0.0}) for sensor in scene.sensors]
    path = tmp_path_factory.mktemp("instant") / "instant.mcap"
    simulate(scene.model_copy(update={"sensors": sensors, "duration_s": 3.0}), path)
    log, truth = api.read_log(path), read_truth(path)
    found = []
    for frame in log.frames.filter(pl.col("time") == pl.col("time").min()).to_dicts():
        at = (pl.col("sensor_id") == frame["sensor_id"]) & (pl.col("time") == frame["time"])
        state = log.states.filter(at).row(0, named=True)
        of = log.cameras.filter(pl.col("sensor_id") == frame["sensor_id"])
        camera = api.Camera(**of.select(api.Camera._fields).row(0, named=True))
        place, velocity = (
            [state[name] for name in names]
            for names in (("x_km", "y_km", "z_km"), ("vx_km_s", "vy_km_s", "vz_km_s"))
        )
        values = (np.array(frame[name]) for name in ("x_px", "y_px", "flux"))
        found.append(Sensor(*values, camera, frame["time"], place, velocity))
    elements = elements_of(truth)
    left_s = -0.13  # light takes so long from this far to the sensors
    return found, state_at(elements, np.full(len(elements), left_s))[0]


def test_the_way_from_pixels_to_positions_finds_the_objects(one_instant, example):
    sensors, there_km = one_instant
    assert len(sensors) == 4
    text = (ROOT / "docs" / "api.md").read_text()
    names: dict = {"sensors": sensors}
    for block in re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE):
        exec(block.replace('"out/', f'"{example}/out/'), names)
    found = names["positions"]
    apart = np.linalg.norm(found.r_gcrf_km[:, None] - there_km, axis=2)
    nearest = apart.argmin(axis=1)
    assert len(set(nearest.tolist())) >= 8  # of nine; a twentieth of the detections is missing
    error = found.r_gcrf_km - there_km[nearest]
    chi2 = np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.cov_km2), error)
    # The sensors' places have a bias of 20 m, the page's 0.15 px is the simulator's: 3 is honest.
    assert 0.5 < np.median(chi2) < 6.0
    assert names["tracklets"]["object"].null_count() == 0
    assert names["orbit"].verdict is None
    assert names["passage"].ra_deg == pytest.approx(names["seen"]["ra_deg"].median(), abs=0.2)

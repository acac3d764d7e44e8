"""Truth folders: sampled orbits, and objects without an orbit."""

import json

import pyarrow.parquet as pq
import pytest
from scenes.little_night import SECOND_NS, T0_NS, little_truth, rows

from epipole.io.simulation.truth import TruthWriter, read_truth
from epipole.schemas.errors import DatasetError
from epipole.schemas.work_tables import TRUE_ORBITS


def write(folder, scenario=None):
    truth = little_truth()
    with TruthWriter(folder, scenario or truth.scenario) as writer:
        writer.write(truth.frames, truth.points)
    return truth


def write_orbits(folder, *samples):
    orbits = [{"object": k, "t_ns": T0_NS + t * SECOND_NS, "x": 7000.0} for k, t in samples]
    pq.write_table(rows(TRUE_ORBITS, *orbits), folder / "orbits.parquet")


def test_a_truth_without_sampled_orbits_has_none(tmp_path):
    written = write(tmp_path)
    found = read_truth(tmp_path)
    assert found.orbits is None
    assert found.points.equals(written.points)


def test_sampled_orbits_are_read_where_they_are(tmp_path):
    scenario = little_truth().scenario | {"targets": [{"name": "a"}, {"name": "b"}]}
    write(tmp_path, scenario)
    write_orbits(tmp_path, (0, 0), (0, 10), (1, 0), (1, 10))
    found = read_truth(tmp_path)
    assert found.orbits["object"].to_pylist() == [0, 0, 1, 1]
    assert found.orbits.schema.equals(TRUE_ORBITS)


@pytest.mark.parametrize("samples", [[], [(1, 0)], [(1, 5), (1, 5)]])
def test_an_object_without_an_orbit_is_an_error_that_names_it(samples, tmp_path):
    write(tmp_path)
    write_orbits(tmp_path, (0, 0), (0, 10), *samples)
    with pytest.raises(DatasetError, match=r"orbits.parquet: no orbit of object 1"):
        read_truth(tmp_path)


def test_an_object_without_elements_is_an_error_that_names_it(tmp_path):
    write(tmp_path)
    scenario = json.loads((tmp_path / "scenario.json").read_text())
    del scenario["targets"][0]["elements"]
    (tmp_path / "scenario.json").write_text(json.dumps(scenario))
    with pytest.raises(DatasetError, match=r"scenario.json: no orbit of object 0"):
        read_truth(tmp_path)

"""Link objects: objects keep their ids across gaps of all sensors."""

import tomllib
from pathlib import Path

import numpy as np
import polars as pl
import pytest

from epipole.schemas.bridge import empty, table
from epipole.schemas.settings import Settings
from epipole.schemas.simulation.scene import validate_scene
from epipole.schemas.tables import ASSOCIATIONS, POSITIONS, STATES
from epipole.tasks.algorithms.orbits.orbit_fit import propagate
from epipole.tasks.name.link_objects import link_objects, outermost, renamed

T0 = 1_554_091_200_000_000_000
GEO = np.array([-39359.89, 15125.76, 64.30, -1.1030, -2.8700, 0.01])
SETTINGS = Settings()
FOUR_SENSORS = Path(__file__).parents[3] / "io/simulation/built_in/four_sensor_geo.toml"


def positions_of(passes):
    """Exact positions every 10 s of objects by id, each with its passes (truth, from, to) [s]."""
    rows = [
        (T0 + int(t * 1e9), name, *propagate(truth, t)[:3])
        for name, truth, first, last in passes
        for t in np.arange(first, last + 1, 10.0)
    ]
    epoch, name, *place = (list(column) for column in zip(*sorted(rows), strict=True))
    zeros = np.zeros(len(name))
    columns = {"epoch": np.array(epoch), "time": np.array(epoch), "object_id": name}
    columns |= {f"{a}_km": p for a, p in zip("xyz", place, strict=True)}
    columns |= {f"cov_{a}{a}": zeros + 1.0 for a in "xyz"}
    columns |= {f"cov_{ab}": zeros for ab in ("xy", "xz", "yz")} | {"chi2": zeros}
    columns |= {n: zeros.astype(np.int32) for n in ("n_sensors", "n_rejected")}
    return table(POSITIONS, columns | {"residual_px": zeros, "independent": zeros > 0})


def states_of(passes):
    """Nearly exact states at the middle of each pass."""
    rows = []
    for name, truth, first, last in passes:
        t = (first + last) / 2
        rows.append((T0 + int(t * 1e9), name, *propagate(truth, t)))
    epoch, name, *state = (list(column) for column in zip(*rows, strict=True))
    columns = {n: np.zeros(len(name)) for n in STATES.names} | {"epoch": np.array(epoch)}
    columns |= {"object_id": name}
    columns |= {n: np.full(len(name), 5, np.int32) for n in ("n_epochs", "n_views", "dof")}
    names = [*(f"{a}_km" for a in "xyz"), *(f"v{a}_km_s" for a in "xyz")]
    columns |= dict(zip(names, state, strict=True))
    columns |= {f"cov_{a}{a}": np.full(len(name), 0.25) for a in "xyz"}
    columns |= {f"cov_v{a}v{a}": np.full(len(name), 1e-6) for a in "xyz"}
    return table(STATES, columns)


OTHER = GEO + np.array([300.0, 0, 0, 0, 0.02, 0])
PASSES = [("1", GEO, 0, 60), ("2", OTHER, 0, 60), ("3", OTHER, 300, 360), ("4", GEO, 330, 400)]


def test_ids_change_to_the_first_one_of_their_object():
    positions, states = positions_of(PASSES), states_of(PASSES)
    new_id = link_objects.fn(positions, states, SETTINGS)
    assert new_id == {"3": "2", "4": "1"}
    ids = set(renamed(positions, new_id)["object_id"].to_pylist())
    assert ids == {"1", "2"}
    assert renamed(positions, {}) is positions


def test_an_object_without_a_state_is_recognised_by_its_position():
    states = states_of(PASSES[:2])
    assert link_objects.fn(positions_of(PASSES), states, SETTINGS) == {"3": "2", "4": "1"}
    assert link_objects.fn(positions_of(PASSES), states.slice(0, 0), SETTINGS) == {}


def test_only_first_and_last_positions_are_needed():
    positions, states = positions_of(PASSES), states_of(PASSES)
    few = outermost(positions)
    assert few.num_rows == 2 * len(PASSES)
    assert link_objects.fn(few, states, SETTINGS) == link_objects.fn(positions, states, SETTINGS)


def test_linking_can_be_switched_off():
    off = SETTINGS.model_copy(
        update={"states": SETTINGS.states.model_copy(update={"link_gap_s": 0.0})}
    )
    assert link_objects.fn(positions_of(PASSES), states_of(PASSES), off) == {}


def test_no_positions_give_no_links():
    assert link_objects.fn(empty(POSITIONS), empty(STATES), SETTINGS) == {}
    assert renamed(empty(ASSOCIATIONS), {"2": "1"}).num_rows == 0


@pytest.fixture(scope="module")
def gap_dataset(prefect, tmp_path_factory):
    """Four sensors see nine objects for 45 s; after ten minutes three of them see them again."""
    from epipole.flows.nightly import nightly
    from epipole.flows.simulate import simulate

    folder = tmp_path_factory.mktemp("gap")
    scene = tomllib.loads(FOUR_SENSORS.read_text())
    scene |= {"duration_s": 690.0, "seed": 5}
    for sensor in scene["sensors"]:
        ends = 690.0 if sensor["id"] == "sat2" else 645.0
        sensor["outages_s"] = [[45.0, ends]]
    simulate(validate_scene(scene, "gap"), folder / "gap.mcap")
    nightly([str(folder / "gap.mcap")], str(folder / "out"))
    return folder


def test_objects_keep_their_ids_across_a_gap_of_all_sensors(gap_dataset):
    def scan(name):
        return pl.read_parquet(gap_dataset / f"out/night=*/{name}/*.parquet")

    positions = scan("positions")
    assert positions["object_id"].n_unique() == 9
    later = positions.filter(pl.col("epoch") > pl.col("epoch").min() + pl.duration(seconds=600))
    assert later["object_id"].n_unique() == 9
    truth = pl.read_parquet(gap_dataset / "gap.mcap.truth/points.parquet")
    views = scan("associations").drop_nulls("centroid")
    views = views.join(truth, on=["sensor_id", "frame_number", "centroid"])
    whose = views.filter(pl.col("kind") == 1).group_by("object_id").agg(pl.col("source").n_unique())
    assert whose["source"].to_list() == [1] * 9
    assert set(scan("states")["object_id"]) == set(positions["object_id"])

"""Orbits of a night: a row per object whose observations fit one, else a row of `rejects`."""

import numpy as np
import polars as pl
import pytest
from scenes.associations import filled
from scenes.night_orbits import GEO, LOW, NOON_NS, trial

from epipole.io.datasets.night_tables import read_columns, write_table
from epipole.schemas.bridge import stack_covariance, to_polars
from epipole.schemas.columns import ELEMENTS, POSITION, STATE_AXES, VELOCITY
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.tables import OBSERVATIONS, ORBITS, POSITIONS, REJECTS, STATES
from epipole.tasks.algorithms.orbits.orbital_elements import elements_of
from epipole.tasks.publish import orbits
from epipole.tasks.publish.orbits import fit_orbits, surroundings_of, write_orbits

NIGHT = "2026-05-30"
R = surroundings_of(NIGHT).R_night_from_gcrf
NOISE, BIAS, PLACE_KM = 2.0, 3.0, 0.02


def gcrf(unknowns):
    return np.concatenate([R.T @ unknowns[:3], R.T @ unknowns[3:6]])


def observed(name, truth, seed=1, **other):
    """OBSERVATIONS of an object around noon."""
    seen = trial(seed, truth, noise=NOISE, bias=BIAS, place_km=PLACE_KM, **other)
    u, n = seen.u @ R, len(seen.u)
    rows = {
        "time": NOON_NS + np.round(seen.time_s * 1e9).astype(np.int64),
        "object_id": [name] * n, "sensor_id": [f"s{k}" for k in seen.sensor],
        "tracklet_id": [f"{name}-{k}" for k in seen.sensor],
        "ra_deg": np.degrees(np.arctan2(u[:, 1], u[:, 0])),
        "dec_deg": np.degrees(np.arcsin(u[:, 2])),
        "sigma_ra_arcsec": [NOISE] * n, "sigma_dec_arcsec": [NOISE] * n,
        "bias_sigma_arcsec": [BIAS] * n, "position_sigma_km": [PLACE_KM] * n,
        **dict(zip(POSITION, (seen.r_km @ R).T, strict=True)),
    }  # fmt: skip
    return to_polars(filled(OBSERVATIONS, n, rows))


def state(name, truth, time_ns=NOON_NS):
    columns = dict(zip([*POSITION, *VELOCITY], gcrf(truth)[:, None] + 1e-3, strict=True))
    rows = {"epoch": [time_ns], "object_id": [name], "n_views": [9], **columns}
    return to_polars(filled(STATES, 1, rows))


def positions(name, truth):
    at = np.array([-2.0, 0.0, 2.0])
    r_km = gcrf(truth)[:3] + at[:, None] * gcrf(truth)[3:]
    rows = {"epoch": NOON_NS + (at * 1e9).astype(np.int64), "object_id": [name] * 3}
    rows |= dict(zip(POSITION, r_km.T, strict=True))
    return to_polars(filled(POSITIONS, 3, rows))


def written(folder, seen, states=(), places=()):
    """Write the tables of a night that orbits are made from."""
    blank = [to_polars(schema.empty_table()) for schema in (OBSERVATIONS, STATES, POSITIONS)]
    for name, schema, rows, time in (
        ("observations", OBSERVATIONS, [blank[0], *seen], "time"),
        ("states", STATES, [blank[1], *states], "epoch"),
        ("positions", POSITIONS, [blank[2], *places], "epoch"),
    ):
        write_table(folder, name, [pl.concat(rows).sort(time).to_arrow().cast(schema)])
    earlier = reject_rows(Reason.NO_POSITION, time=[NOON_NS], count=[1])
    write_table(folder, "rejects", [earlier])


def made(folder, shares=1):
    """Return the orbits and the rejects of a night."""
    fitted = [fit_orbits.fn(folder, NIGHT, k, shares) for k in range(shares)]
    assert write_orbits.fn(folder, NIGHT, fitted) == sum(each.orbits.num_rows for each in fitted)
    rejects = read_columns(folder, "rejects", REJECTS.names)
    return read_columns(folder, "orbits", ORBITS.names), rejects


def test_objects_have_an_orbit_from_states_or_positions(tmp_path):
    low = np.linspace(-60.0, 60.0, 25)
    seen = [observed("high", GEO), observed("low", LOW, times_s=low)]
    written(tmp_path, seen, [state("high", GEO)], [positions("low", LOW)])
    rows, rejects = made(tmp_path)
    assert rejects["reason"].to_pylist() == ["no_position"]
    assert sorted(rows["object_id"].to_pylist()) == ["high", "low"]
    for k, row in enumerate(rows.to_pylist()):
        truth = {"high": GEO, "low": LOW}[row["object_id"]]
        off = np.array([row[name] for name in (*POSITION, *VELOCITY)]) - gcrf(truth)
        cov = stack_covariance(rows, "cov_{}", STATE_AXES)[k]
        assert off @ np.linalg.solve(cov, off) < 22.5  # 1 in 1,000 is above
        assert row["n_sensors"] == row["n_tracklets"] == 3
        assert row["dof"] == 2 * row["n_observations"] - 6
        elements = elements_of(gcrf(truth)) * [1, 1, *np.degrees(np.ones(4))]
        for name, value in zip(ELEMENTS, elements, strict=True):
            assert abs(row[name] - value) < 5 * row[f"sigma_{name}"]
    high, low = sorted(rows.to_pylist(), key=lambda row: row["object_id"])
    assert (high["arc_s"], low["arc_s"]) == (600.0, 120.0)
    assert "radiation 0.0" in high["forces"]
    assert low["forces"] == "GM J2-J4 C22 Sun Moon"
    assert high["sigma_drift_deg_day"] > 0.0
    assert low["longitude_deg"] is None
    assert low["drift_deg_day"] is None


def test_an_arc_of_two_objects_is_a_reject(tmp_path):
    other = GEO + 40.0 * np.eye(8)[2]
    seen = observed("a", GEO).filter(pl.col("sensor_id") != "s0")
    wrong = observed("a", other, toward=GEO).filter(pl.col("sensor_id") == "s0")
    written(tmp_path, [seen, wrong], [state("a", GEO)])
    rows, rejects = made(tmp_path)
    assert rows.num_rows == 0
    assert rejects["reason"].to_pylist() == ["no_position", "orbit_misfit"]
    assert rejects["stage"].to_pylist() == ["solve", "solve"]
    # A task that runs again adds nothing.
    assert made(tmp_path)[1].equals(rejects)


def test_an_object_without_state_or_position_has_an_orbit_by_its_observations(tmp_path):
    written(tmp_path, [observed("a", GEO)])
    written(tmp_path / "with", [observed("a", GEO)], [state("a", GEO)])
    (alone,), (started,) = made(tmp_path)[0].to_pylist(), made(tmp_path / "with")[0].to_pylist()
    for name in (*POSITION, "chi2", "drift_deg_day"):
        # Both have converged, to a thousandth of a sigma.
        assert alone[name] == pytest.approx(started[name], rel=1e-3)


def test_too_few_observations_are_a_reject(tmp_path):
    written(tmp_path, [observed("a", GEO).head(3)], [state("a", GEO)])
    rows, rejects = made(tmp_path)
    assert rows.num_rows == 0
    assert sorted(rejects["reason"].to_pylist()) == ["no_orbit", "no_position"]


def test_a_row_does_not_depend_on_the_objects_or_tasks_beside_it(tmp_path):
    names = [f"o{k}" for k in range(5)]
    seen = [observed(name, GEO, seed=k) for k, name in enumerate(names)]
    written(tmp_path / "all", seen, [state(name, GEO) for name in names])
    written(tmp_path / "one", seen[3:4], [state("o3", GEO)])
    rows, _ = made(tmp_path / "all")
    assert made(tmp_path / "all", shares=3)[0].equals(rows)
    one, _ = made(tmp_path / "one")
    assert one.equals(rows.filter(pl.Series(rows["object_id"]).to_numpy() == "o3"))


def test_a_night_without_objects_has_no_orbits(tmp_path):
    written(tmp_path, [])
    rows, rejects = made(tmp_path)
    assert rows.num_rows == 0
    assert rejects.num_rows == 1


@pytest.mark.parametrize("rows", [0, 1, 299_999, 300_001])
def test_large_nights_are_shared_out(monkeypatch, tmp_path, rows):
    monkeypatch.setattr(orbits.NightReader, "count", lambda *_: rows)
    assert orbits.orbit_shares(tmp_path, NIGHT) == (2 if rows > 300_000 else 1)

"""Orbits of a night: a row per object whose observations fit one, else a row of `rejects`."""

import shutil

import numpy as np
import polars as pl
import pytest
from scenes.associations import filled
from scenes.night_orbits import AROUND, GEO, LOW, NOON_NS, trial
from scenes.night_orbits import positions as where

from epipole.io.datasets.night_tables import read_columns, write_table
from epipole.schemas.bridge import stack, stack_covariance, to_polars
from epipole.schemas.columns import ELEMENTS, POSITION, SHARED_AXES, STATE_AXES, VELOCITY
from epipole.schemas.observation import FITTED_FIELDS
from epipole.schemas.rejects import ObjectVerdict, Reason, reject_rows
from epipole.schemas.tables import OBSERVATIONS, ORBITS, POSITIONS, REJECTS, SENSOR_ERRORS, STATES
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.orbits.illumination import illumination
from epipole.tasks.algorithms.orbits.orbit_determination import DeterminedOrbit
from epipole.tasks.algorithms.orbits.orbital_elements import elements_of
from epipole.tasks.algorithms.orbits.shared_errors import no_equations
from epipole.tasks.algorithms.orbits.trajectories import propagate_unknowns
from epipole.tasks.common.orbit_forces import surroundings_of
from epipole.tasks.publish import manoeuvres, orbits
from epipole.tasks.publish.fitted_observations import complete_observations
from epipole.tasks.publish.object_orbits import (
    FittedOrbit,
    best_orbit,
    judge,
    observed_objects,
)
from epipole.tasks.publish.orbits import fit_orbits, write_orbits
from epipole.tasks.publish.share_out import share_out

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
    time_ns = NOON_NS + (at * 1e9).astype(np.int64)
    rows = {"epoch": time_ns, "time": time_ns, "object_id": [name] * 3}
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
    shutil.rmtree(folder.with_name(f"{folder.name}-shared"), ignore_errors=True)
    share_out.fn(folder, NIGHT, shares)
    fitted = [fit_orbits.fn(folder, NIGHT, k, shares) for k in range(shares)]
    assert write_orbits.fn(folder, NIGHT, fitted) == sum(each.orbits.num_rows for each in fitted)
    rejects = read_columns(folder, "rejects", REJECTS.names)
    return read_columns(folder, "orbits", ORBITS.names), rejects


def test_rows_without_an_object_come_first(tmp_path):
    seen = observed("high", GEO)
    written(tmp_path, [seen], [state("high", GEO)])
    nobody = seen.with_columns(object_id=pl.lit(None, pl.String))
    write_table(tmp_path, "observations", [
        rows.to_arrow().cast(OBSERVATIONS) for rows in (nobody, seen)
    ])  # fmt: skip
    assert made(tmp_path)[0]["object_id"].to_pylist() == ["high"]


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
    assert rejects["reason"].to_pylist() == ["orbit_misfit", "no_position"]
    assert rejects["stage"].to_pylist() == ["publish", "solve"]
    # A task that runs again adds nothing.
    assert made(tmp_path)[1].equals(rejects)


def changed(truth, at_s, km_s):
    """Return the orbit at noon that leads to a velocity that is changed at a time."""
    there, _ = propagate_unknowns(truth, 0.0, at_s, AROUND)
    there[3:6] += km_s
    return propagate_unknowns(there, at_s, 0.0, AROUND)[0]


def after_and_before(truth, times_s, at_s, km_s, **other):
    """Return observations of an object that changes its velocity at a time."""
    later = changed(truth, at_s, km_s)
    seen = [
        observed("a", each, times_s=times_s[rows], toward=truth, **other)
        for each, rows in ((truth, times_s < at_s), (later, times_s >= at_s))
    ]
    return seen, later


@pytest.mark.parametrize(
    ("truth", "times_s", "at_s", "km_s"),
    [
        (GEO, np.linspace(-5400.0, 5400.0, 80), 1500.0, [2e-3, 1e-3, 0.0]),
        (LOW, np.concatenate([np.linspace(-300, -200, 20), np.linspace(200, 300, 20)]), 40.0,
         [0.0, 0.05, 0.05]),
    ],
    ids=["geostationary, watched all the time", "low, between two passages"],
)  # fmt: skip
def test_a_change_of_the_orbit_is_found(tmp_path, truth, times_s, at_s, km_s):
    seen, later = after_and_before(truth, times_s, at_s, km_s)
    written(tmp_path, seen, [state("a", truth)])
    share_out.fn(tmp_path, NIGHT, 1)
    fitted = fit_orbits.fn(tmp_path, NIGHT, 0, 1)
    assert fitted.verdicts == {"a": ObjectVerdict.MANOEUVRED}
    assert write_orbits.fn(tmp_path, NIGHT, [fitted]) == 1
    table = read_columns(tmp_path, "orbits", ORBITS.names)
    row = to_polars(table)
    epoch_s = (row["epoch"].cast(pl.Int64)[0] - NOON_NS) / 1e9
    assert epoch_s > at_s
    there, _ = propagate_unknowns(later, 0.0, epoch_s, AROUND)
    off = row.select(*POSITION, *VELOCITY).to_numpy()[0] - gcrf(there)
    cov = stack_covariance(table, "cov_{}", STATE_AXES)[0]
    assert off @ np.linalg.solve(cov, off) < 22.5  # 1 in 1,000 is above
    rejects = to_polars(read_columns(tmp_path, "rejects", REJECTS.names))
    of_change = rejects.filter(pl.col("reason") == "manoeuvre")
    found_s = (of_change["time"].cast(pl.Int64).item() - NOON_NS) / 1e9
    assert abs(found_s - at_s) < max(300.0, np.diff(times_s).max())
    n_before, n_after = (len(each) for each in seen)
    assert abs(of_change["count"].item() - n_before) <= 0.1 * (n_before + n_after)
    complete_observations.fn(tmp_path, NIGHT, 1)
    columns = ["time", "residual_sigma", "range_km", *POSITION]
    rows = to_polars(read_columns(tmp_path, "observations", columns))
    is_after = rows["time"].cast(pl.Int64) > NOON_NS + found_s * 1e9
    assert (rows["residual_sigma"].is_not_null() == is_after).all()
    # The orbit before the change tells the ranges before it.
    for of, kept in ((truth, ~is_after), (later, is_after)):
        of_part = rows.filter(kept)
        seconds = (of_part["time"].cast(pl.Int64).to_numpy() - NOON_NS) / 1e9
        there = np.array([gcrf(propagate_unknowns(of, 0.0, t, AROUND)[0])[:3] for t in seconds])
        ranges = np.linalg.norm(there - of_part.select(POSITION).to_numpy(), axis=1)
        np.testing.assert_allclose(of_part["range_km"].to_numpy(), ranges, atol=5.0)


def test_vague_orbits_that_meet_by_their_errors_are_no_change_of_an_orbit(tmp_path):
    # One sensor follows the one object for 20 s, another one the other object ten minutes later.
    times_s = np.linspace(-10.0, 10.0, 21)
    before, after = times_s - 300.0, times_s + 300.0
    other = LOW + np.array([0.0, 40.0, -30.0, 0.02, 0.0, 0.03, 0.0, 0.0])
    for seed in range(4):
        seen = [
            observed("a", LOW, times_s=before, n_sensors=1, seed=seed),
            observed("a", other, times_s=after, n_sensors=1, seed=seed + 9).with_columns(
                sensor_id=pl.lit("s9"), tracklet_id=pl.lit("a-9")
            ),
        ]
        written(tmp_path, seen, [state("a", LOW)])
        rows, rejects = made(tmp_path)
        assert rows.num_rows == 0
        assert "manoeuvre" not in rejects["reason"].to_pylist()


def test_two_objects_one_after_the_other_are_no_change_of_an_orbit(tmp_path):
    times_s = np.linspace(-5400.0, 5400.0, 80)
    other = GEO + 60.0 * np.eye(8)[2]
    seen = [
        observed("a", each, times_s=times_s[rows], toward=GEO)
        for each, rows in ((GEO, times_s < 0.0), (other, times_s >= 0.0))
    ]
    written(tmp_path, seen, [state("a", GEO)])
    share_out.fn(tmp_path, NIGHT, 1)
    assert fit_orbits.fn(tmp_path, NIGHT, 0, 1).verdicts == {"a": ObjectVerdict.ORBIT_MISFIT}


def test_an_object_without_state_or_position_has_an_orbit_by_its_observations(tmp_path):
    written(tmp_path, [observed("a", GEO)])
    written(tmp_path / "with", [observed("a", GEO)], [state("a", GEO)])
    (alone,), (started,) = made(tmp_path)[0].to_pylist(), made(tmp_path / "with")[0].to_pylist()
    for name in (*POSITION, "chi2", "drift_deg_day"):
        # Both have converged, to a thousandth of a sigma.
        assert alone[name] == pytest.approx(started[name], rel=1e-3)


def test_an_object_with_a_single_position_has_an_orbit(tmp_path):
    times_s = np.arange(-5.0, 6.0)
    written(tmp_path, [observed("a", LOW, times_s=times_s)], [], [positions("a", LOW)[1:2]])
    rows, _ = made(tmp_path)
    off = np.array([rows[name][0].as_py() for name in (*POSITION, *VELOCITY)]) - gcrf(LOW)
    cov = stack_covariance(rows, "cov_{}", STATE_AXES)[0]
    assert off @ np.linalg.solve(cov, off) < 22.5  # 1 in 1,000 is above


def test_directions_of_one_instant_are_no_orbit(tmp_path):
    seen = observed("a", LOW, times_s=np.zeros(1), n_sensors=5)
    written(tmp_path, [seen], [], [positions("a", LOW)[1:2]])
    rows, rejects = made(tmp_path)
    assert rows.num_rows == 0
    assert sorted(rejects["reason"].to_pylist()) == ["no_orbit", "no_position"]


def completed(folder, shares=1):
    """Return the observations of a night with what its orbits add."""
    made(folder, shares)
    complete_observations.fn(folder, NIGHT, shares)
    return to_polars(read_columns(folder, "observations", OBSERVATIONS.names))


def test_observations_have_their_residuals_and_how_their_object_is_lit(tmp_path):
    low = np.linspace(-60.0, 60.0, 25)
    bright = observed("low", LOW, times_s=low).with_columns(magnitude=pl.lit(6.0))
    seen = [observed("high", GEO), bright, bright.head(2).with_columns(object_id=None)]
    written(tmp_path, seen, [state("high", GEO)], [positions("low", LOW)])
    before = to_polars(read_columns(tmp_path, "observations", OBSERVATIONS.names))
    rows = completed(tmp_path)
    names = [field.name for field in FITTED_FIELDS]
    assert rows.drop(names).equals(before.drop(names))
    assert rows.filter(pl.col("object_id").is_null()).select(names).null_count().row(0) == (2,) * 5
    fitted = rows.drop_nulls("object_id")
    # 138 chi-squares of two degrees of freedom, less what is fitted.
    assert (fitted["residual_sigma"] ** 2).mean() == pytest.approx(2.0, abs=5 * 2 / np.sqrt(138))
    for name, truth in (("high", GEO), ("low", LOW)):
        of = fitted.filter(object_id=name)
        time_ns = of["time"].dt.epoch("ns").to_numpy()
        sensor_km = of.select(POSITION).to_numpy()
        true_km = where(truth, (time_ns - NOON_NS) / 1e9) @ R
        lit = illumination(time_ns, true_km, sensor_km)
        assert of["sunlit"].to_list() == lit.sunlit.tolist()
        # Light time, at most 0.15 s of 7 km/s, and the errors of the orbit.
        np.testing.assert_allclose(of["range_km"], lit.range_km, atol=3.0)
        np.testing.assert_allclose(of["phase_deg"], np.degrees(lit.phase_rad), atol=0.2)
        reduced = of["magnitude"] - 5 * (of["range_km"] / 1000).log(10)
        assert reduced.null_count() == (len(of) if name == "high" else 0)
        np.testing.assert_allclose(of["magnitude_1000_km"].to_numpy(), reduced.to_numpy())
    assert completed(tmp_path, shares=3).equals(rows)


def test_an_object_without_an_orbit_is_located_between_its_positions(tmp_path):
    low = np.array([-40.0, -1.0, 0.5, 1.9, 3.0])
    seen = observed("low", LOW, times_s=low, n_sensors=1)
    mixed = seen.with_columns(dec_deg=pl.col("dec_deg") + pl.Series([0.0, 5.0, -5.0, 5.0, 0.0]))
    written(tmp_path, [mixed], [], [positions("low", LOW)])
    rows = completed(tmp_path)
    assert rows["residual_sigma"].null_count() == 5
    assert rows["range_km"].is_null().to_list() == [True, False, False, False, True]
    assert rows["sunlit"].is_null().to_list() == [True, False, False, False, True]
    true_km = where(LOW, low[1:4]) @ R
    off = np.linalg.norm(true_km - rows.select(POSITION).to_numpy()[1:4], axis=1)
    np.testing.assert_allclose(rows["range_km"][1:4], off, atol=0.3)


def test_sensors_have_their_errors_as_all_orbits_show_them(tmp_path):
    names = [f"o{k}" for k in range(4)]
    rng = np.random.default_rng(3)
    shared = rng.normal(size=(3, 3)) * 100 * ARCSEC, np.zeros((3, 3))
    seen = [
        observed(name, (GEO, LOW)[k % 2], seed=k, shared=shared,
                 times_s=np.linspace(-60.0, 60.0, 15)).with_columns(bias_sigma_arcsec=100.0)
        for k, name in enumerate(names)
    ]  # fmt: skip
    written(tmp_path, seen, [state(name, (GEO, LOW)[k % 2]) for k, name in enumerate(names)])
    made(tmp_path)
    rows = read_columns(tmp_path, "sensor_errors", SENSOR_ERRORS.names)
    assert rows["sensor_id"].to_pylist() == ["s0", "s1", "s2"]
    assert rows["n_objects"].to_pylist() == [4] * 3
    assert rows["n_observations"].to_pylist() == [60] * 3
    np.testing.assert_allclose(rows["bias_sigma_arcsec"], 100.0)
    cov = stack_covariance(rows, "cov_{}", SHARED_AXES)
    bias = stack(rows, "direction_error_{}_arcsec")
    off = bias - shared[0] / ARCSEC @ R
    square = np.einsum("si,sij,sj->s", off, np.linalg.inv(cov[:, :3, :3]), off)
    assert square.max() < 16.3  # 1 in 1,000 of three degrees of freedom is above
    assert np.trace(cov[:, :3, :3], axis1=1, axis2=2).max() < 3 * 100.0**2
    made(tmp_path, shares=3)
    other = read_columns(tmp_path, "sensor_errors", SENSOR_ERRORS.names)
    np.testing.assert_allclose(stack(other, "direction_error_{}_arcsec"), bias, rtol=1e-6)


def test_the_position_of_a_satellite_counts_once_for_all_its_sensors():
    """Three sensors of each of two satellites see an object one after the other."""
    blocks, n = np.array([0.0, 40.0, 80.0]), 40
    times_s = np.concatenate([block + np.arange(0.0, 20.0, 2.0) for block in blocks])
    around, square = surroundings_of(NIGHT), []
    for seed in range(n):
        seen = observed("a", LOW, seed=seed, times_s=times_s, n_sensors=2, shared=(
            np.zeros((2, 3)), np.random.default_rng([seed, 1]).normal(size=(2, 3)) * 0.1
        )).with_columns(position_sigma_km=0.1, bias_sigma_arcsec=0.0)  # fmt: skip
        block = (pl.col("time").cast(pl.Int64) - NOON_NS) // 40_000_000_000
        seen = seen.with_columns(sensor_id=pl.format("{}-{}", "sensor_id", block))
        rows = seen.sort("object_id", "time", "sensor_id")
        directions = observed_objects(rows, NOON_NS, around).directions(0)
        assert len(directions.prior) == 6
        fitted = best_orbit(directions, None, NOON_NS, around)
        truth, _ = propagate_unknowns(LOW, 0.0, fitted.epoch_s, AROUND)
        off = (fitted.orbit.unknowns - truth)[:6]
        square.append(off @ np.linalg.solve(fitted.orbit.cov[:6, :6], off))
    # The mean of n chi-squares of 6 degrees over 6 has a sigma of sqrt(1 / 3 n).
    assert abs(np.mean(square) / 6 - 1) < 3.5 * np.sqrt(1 / (3 * n))


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
    assert not len(completed(tmp_path))
    assert not read_columns(tmp_path, "sensor_errors", SENSOR_ERRORS.names).num_rows
    rows, rejects = made(tmp_path)
    assert rows.num_rows == 0
    assert rejects.num_rows == 1


@pytest.mark.parametrize("rows", [0, 1, 299_999, 300_001])
def test_large_nights_are_shared_out(monkeypatch, tmp_path, rows):
    monkeypatch.setattr(orbits.NightReader, "count", lambda *_: rows)
    assert orbits.orbit_shares(tmp_path, NIGHT) == (2 if rows > 300_000 else 1)


def test_the_cut_that_explains_most_is_found_wherever_it_is():
    for span in range(60):
        for best in range(span + 1):
            assert manoeuvres._least(lambda k, best=best: float(abs(k - best)), 0, span) == best


@pytest.mark.parametrize(
    ("n", "square", "reason"),
    [
        (600_000, 1.02, None),
        (600_000, 1.10, Reason.ORBIT_MISFIT),
        (50, 1.30, None),
        (50, 2.20, Reason.ORBIT_MISFIT),
    ],
)
def test_a_million_directions_may_have_sigmas_that_are_right_to_a_per_cent(n, square, reason):
    dof = 2 * n - 6
    orbit = DeterminedOrbit(
        np.zeros(8), np.eye(8), square * dof, np.ones(n, bool), np.zeros((1, 6)), np.zeros(n),
        no_equations(1),
    )  # fmt: skip
    assert judge(FittedOrbit(orbit, 0.0, "")) == reason


@pytest.mark.parametrize("gap_s", [700.0, 1200.0])
def test_two_passages_a_quarter_of_an_hour_apart_have_an_orbit_without_a_start(gap_s):
    times_s = np.concatenate([side * gap_s / 2 + np.linspace(-5, 5, 9) for side in (-1, 1)])
    squares = []
    for seed in range(16):
        seen = trial(seed, LOW, times_s=times_s, n_sensors=2)
        rows = np.flatnonzero(seen.sensor == (seen.time_s > 0))
        passages = type(seen)(*(a[rows] for a in seen[:-1]), seen.prior)
        found = best_orbit(passages, None, NOON_NS, AROUND)
        assert judge(found) is None
        off = (found.orbit.unknowns - LOW)[:6]
        squares.append(off @ np.linalg.solve(found.orbit.cov[:6, :6], off))
    assert max(squares) < 22.5  # 1 in 1,000 is above

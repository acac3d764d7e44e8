"""Fit states: honest covariances, arcs, and which epochs are used."""

import numpy as np
import pyarrow as pa
import pytest
from scenes.arcs import GEO, trial

from epipole.schemas.bridge import array, empty, stack, table
from epipole.schemas.settings import Settings
from epipole.schemas.tables import ASSOCIATIONS, POSITIONS, STATES
from epipole.schemas.work_tables import SHARED_ERRORS, VIEWS
from epipole.tasks.algorithms.orbits.orbit_fit import propagate
from epipole.tasks.solve.states import fit_states, judge_errors, refuse_misfits, with_larger_errors

T0 = 1_554_091_200_000_000_000
SETTINGS = Settings()


def night(seed, times, independent=None, name="a", **scene):
    """Views of one object, claimed, and its positions with an error of some kilometres."""
    arcs = trial(seed, times=times, **scene)
    n = len(arcs.time_s)
    epoch = T0 + np.round(arcs.time_s * 1e9).astype(np.int64)
    shared = {
        "epoch": epoch,
        "sensor_id": [f"s{s}" for s in arcs.sensor],
        "frame_number": np.arange(n),
        "centroid": np.zeros(n, np.int32),
        "tracklet_id": [f"s{s}-1" for s in arcs.sensor],
        "x_px": np.arange(n) + 1000.0 * scene.get("number", 0),
        "y_px": np.zeros(n),
    }
    views = shared | {f"u{a}": arcs.u[:, i] for i, a in enumerate("xyz")}
    views |= {f"w{a}_rad_s": np.zeros(n) for a in "xyz"}
    views |= {f"{a}_km": arcs.r_km[:, i] for i, a in enumerate("xyz")}
    for which, cov in (("noise", arcs.cov_noise), ("bias", arcs.cov_bias)):
        for ab, i, j in (("11", 0, 0), ("12", 0, 1), ("22", 1, 1)):
            views[f"cov_{which}_{ab}_rad2"] = cov[:, i, j]
    views |= {"position_sigma_km": arcs.sigma_km, "pixel_rad": np.full(n, 7e-5)}
    views |= {"first_fitted": epoch, "last_fitted": epoch, "unmodelled_rad2": np.zeros(n)}
    views["blend_rad2"] = np.zeros(n)
    views |= {f"moment_{k}": np.zeros(n) for k in "123"}
    views |= {f"sensor_v{a}_km_s": np.zeros(n) for a in "xyz"}
    claimed = shared | {"object_id": [name] * n, "epipolar_px": np.zeros(n),
                        "used": np.ones(n, bool)}  # fmt: skip
    at = np.unique(arcs.time_s)
    where = np.array([propagate(GEO, t)[:3] for t in at])
    where += np.random.default_rng(seed).normal(size=where.shape) * 2
    positions = {"epoch": T0 + np.round(at * 1e9).astype(np.int64), "object_id": [name] * len(at)}
    positions["time"] = positions["epoch"]
    positions |= {f"{a}_km": where[:, i] for i, a in enumerate("xyz")}
    positions["independent"] = np.ones(len(at), bool) if independent is None else independent
    for name in POSITIONS.names:
        if name not in positions:
            integer = name in ("n_sensors", "n_rejected")
            positions[name] = np.zeros(len(at), np.int32 if integer else float)
    return table(VIEWS, views), table(ASSOCIATIONS, claimed), table(POSITIONS, positions)


def errors(states):
    """Each state's error and its covariance."""
    at = (array(states, "epoch") - T0) / 1e9
    truth = np.array([propagate(GEO, t) for t in at]).reshape(-1, 6)
    found = np.hstack([stack(states, "{}_km"), stack(states, "v{}_km_s")])
    names = ["x", "y", "z", "vx", "vy", "vz"]
    cov = np.empty((states.num_rows, 6, 6))
    for i, a in enumerate(names):
        for j in range(i, 6):
            cov[:, i, j] = cov[:, j, i] = array(states, f"cov_{a}{names[j]}")
    return found - truth, cov


def test_errors_of_states_agree_with_their_covariances():
    square = []
    for seed in range(60):
        off, cov = errors(fit_states(*night(seed, np.arange(-60.0, 61, 20)), SETTINGS))
        square.append(off[0] @ np.linalg.solve(cov[0], off[0]))
    assert abs(np.mean(square) / 6 - 1) < 0.22  # three sigma of a mean of 60


def test_epochs_that_share_detections_are_not_used():
    states = fit_states(*night(1, np.arange(0.0, 61), np.arange(61) % 12 == 0), SETTINGS)
    assert states["n_epochs"].to_pylist() == [6]


def test_a_long_pass_is_cut_into_arcs():
    states = fit_states(*night(2, np.arange(0.0, 1500, 50)), SETTINGS)
    assert states.num_rows == 3
    assert states["n_epochs"].to_pylist() == [13, 13, 4]


def test_an_arc_of_two_epochs_gives_no_state():
    assert fit_states(*night(3, np.array([0.0, 20.0])), SETTINGS).num_rows == 0


def test_views_that_a_position_rejected_are_not_used():
    views, claimed, positions = night(4, np.arange(-60.0, 61, 20))
    wrong = array(views, "sensor_id") == "s0"
    u = stack(views, "u{}")
    u[wrong] += 1e-3
    for i, a in enumerate("xyz"):
        k = views.schema.get_field_index(f"u{a}")
        views = views.set_column(k, views.schema.field(k), [u[:, i]])
    used = claimed.schema.get_field_index("used")
    claimed = claimed.set_column(used, claimed.schema.field(used), [~wrong])
    off, cov = errors(fit_states(views, claimed, positions, SETTINGS))
    assert off[0] @ np.linalg.solve(cov[0], off[0]) < 25


@pytest.mark.parametrize("which", ["views", "positions"])
def test_empty_tables_give_no_state(which):
    tables = [empty(VIEWS), empty(ASSOCIATIONS), empty(POSITIONS)]
    if which == "views":
        tables[2] = night(5, np.arange(3.0))[2]
    states = fit_states(*tables, SETTINGS)
    assert states.schema == STATES
    assert states.num_rows == 0


def test_a_state_that_does_not_fit_is_refused_and_has_a_reject():
    views, claimed, positions = night(1, np.arange(-60.0, 61, 20))
    states = fit_states(views, claimed, positions, SETTINGS)
    assert states["dof"].to_pylist() == [2 * states["n_views"][0].as_py() - 6]
    kept, rejects = refuse_misfits(states)
    assert kept.equals(states)
    assert rejects.num_rows == 0
    half = views.num_rows // 2
    x = array(views, "ux").copy()
    x[half:] += 1e-3  # another object from here on
    at = views.schema.get_field_index("ux")
    mixed = views.set_column(at, views.schema.field(at), pa.array(x))
    kept, rejects = refuse_misfits(fit_states(mixed, claimed, positions, SETTINGS))
    assert kept.num_rows == 0
    assert rejects["reason"].to_pylist() == ["state_misfit"]


def objects(worse):
    """A night of six objects; the place of the first of five sensors is worse than stated."""
    nights = [
        night(7, np.arange(-143.0, 144.0, 26.0), name=f"o{k}", number=k, worse=worse,
              n_sensors=5, noise=1.5, bias=0.0, place_km=0.02)
        for k in range(6)
    ]  # fmt: skip
    return [pa.concat_tables(tables) for tables in zip(*nights, strict=True)]


def honest_views(views, claimed, positions):
    """Views with the shared errors that all objects together show."""
    return with_larger_errors(views, judge_errors(views, claimed, positions, SETTINGS))


@pytest.mark.parametrize("worse", [30.0, 150.0])
def test_views_of_a_sensor_with_a_worse_ephemeris_have_a_larger_sigma(worse):
    """Also where it is so much worse that no state of any object fits."""
    views, claimed, positions = objects(worse=worse)
    honest = honest_views(views, claimed, positions)
    wider = array(honest, "position_sigma_km") / array(views, "position_sigma_km")
    first = array(views, "sensor_id") == "s0"
    # Of this, the part that this seed drew and that the Student distribution allows.
    assert (wider[first] > 3).all()
    assert (wider[~first] < 1.5).all()
    same = [name for name in views.column_names if name != "position_sigma_km"]
    assert honest.select(same).equals(views.select(same))


def test_views_of_sound_sensors_keep_their_sigmas():
    views, claimed, positions = objects(worse=1.0)
    honest = honest_views(views, claimed, positions)
    wider = array(honest, "position_sigma_km") / array(views, "position_sigma_km")
    assert (wider < 1.3).all()


def test_no_views_stay_no_views():
    views = empty(VIEWS)
    errors = judge_errors(views, empty(ASSOCIATIONS), empty(POSITIONS), SETTINGS)
    assert errors.equals(empty(SHARED_ERRORS))
    assert with_larger_errors(views, errors) is views


def test_only_sensors_whose_errors_are_larger_have_a_row():
    views, claimed, positions = objects(worse=150.0)
    errors = judge_errors(views, claimed, positions, SETTINGS)
    rows = {row["sensor_id"]: row for row in errors.to_pylist()}
    assert all(max(row["direction"], row["place"]) > 1.0 for row in rows.values())
    assert all(min(row["direction"], row["place"]) >= 1.0 for row in rows.values())
    assert rows["s0"]["place"] > 9.0  # of the variance: three sigma


def test_views_have_the_larger_errors_of_their_sensors():
    views, _, _ = objects(worse=1.0)
    views = with_biases(views)
    errors = table(
        SHARED_ERRORS, {"sensor_id": ["s3", "absent"], "direction": [4.0, 2.0], "place": [9.0, 2.0]}
    )
    wider = with_larger_errors(views, errors)
    own = array(views, "sensor_id") == "s3"
    for name, factor in {
        "position_sigma_km": 3.0, "cov_bias_11_rad2": 4.0, "cov_bias_12_rad2": 4.0,
        "cov_bias_22_rad2": 4.0,
    }.items():  # fmt: skip
        expected = array(views, name) * np.where(own, factor, 1.0)
        np.testing.assert_allclose(array(wider, name), expected, rtol=1e-12)
    same = [name for name in views.column_names if "bias" not in name and "sigma" not in name]
    assert wider.select(same).equals(views.select(same))


def with_biases(views):
    for k, axes in enumerate(("11", "12", "22")):
        name = f"cov_bias_{axes}_rad2"
        at = views.schema.get_field_index(name)
        values = np.full(views.num_rows, (3.0, 1.0, 2.0)[k] * 1e-10)
        views = views.set_column(at, views.schema.field(at), [values])
    return views

"""Fit states: honest covariances, arcs, and which epochs are used."""

import numpy as np
import pytest
from scenes.arcs import GEO, trial

from epipole.schemas.bridge import array, concat, empty, stack, table
from epipole.schemas.settings import StateSettings
from epipole.schemas.tables import STATES
from epipole.schemas.work_tables import SHARED_ERRORS, VIEWS
from epipole.tasks.algorithms.orbits.orbit_fit import propagate
from epipole.tasks.common.grouping import group_offsets
from epipole.tasks.solve.states import fit_states, judge_errors, refuse_misfits
from epipole.tasks.solve.view_groups import ViewGroups, unpack_views, with_larger_errors

T0 = 1_554_091_200_000_000_000
SETTINGS = StateSettings()


def night(seed, times, independent=None, numbers=(0,), **scene):
    """Groups of views of some objects, with positions that are some kilometres off."""
    tables = [_views(trial(seed, times=times, number=k, **scene)) for k in numbers]
    number = np.repeat(numbers, [rows.num_rows for rows in tables])
    views = unpack_views(concat(VIEWS, tables), number)
    row = np.lexsort((views.sensor, number, views.epoch_ns))
    views = views.take(row)
    offsets = group_offsets(views.epoch_ns, views.object_number)
    epoch_ns = views.epoch_ns[offsets[:-1]]
    n = len(epoch_ns)
    where = np.array([propagate(GEO, (t - T0) / 1e9)[:3] for t in epoch_ns])
    return ViewGroups(
        views=views, row=row, offsets=offsets, epoch_ns=epoch_ns,
        object_id=np.array([f"o{k}" for k in views.object_number[offsets[:-1]]], object),
        x_km=where + np.random.default_rng(seed).normal(size=where.shape) * 2,
        cov_km2=np.zeros((n, 3, 3)), velocity_km_s=np.zeros((n, 3)), chi2=np.ones(n),
        mean_range_km=np.ones(n), used=np.ones(len(row), bool),
        independent=np.ones(n, bool) if independent is None else independent,
    )  # fmt: skip


def _views(arcs):
    n = len(arcs.time_s)
    epoch = T0 + np.round(arcs.time_s * 1e9).astype(np.int64)
    views = {name: np.zeros(n) for name in VIEWS.names} | {
        "epoch": epoch, "first_fitted": epoch, "last_fitted": epoch,
        "sensor_id": [f"s{s}" for s in arcs.sensor], "frame_number": np.arange(n),
        "centroid": np.zeros(n, np.int32), "tracklet_id": [f"s{s}-1" for s in arcs.sensor],
        "position_sigma_km": arcs.sigma_km, "pixel_rad": np.full(n, 7e-5),
        **{f"u{a}": arcs.u[:, i] for i, a in enumerate("xyz")},
        **{f"{a}_km": arcs.r_km[:, i] for i, a in enumerate("xyz")},
    }  # fmt: skip
    for which, cov in (("noise", arcs.cov_noise), ("bias", arcs.cov_bias)):
        for ab, i, j in (("11", 0, 0), ("12", 0, 1), ("22", 1, 1)):
            views[f"cov_{which}_{ab}_rad2"] = cov[:, i, j]
    return table(VIEWS, views)


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
        off, cov = errors(fit_states(night(seed, np.arange(-60.0, 61, 20)), SETTINGS))
        square.append(off[0] @ np.linalg.solve(cov[0], off[0]))
    assert abs(np.mean(square) / 6 - 1) < 0.22  # three sigma of a mean of 60


def test_epochs_that_share_detections_are_not_used():
    states = fit_states(night(1, np.arange(0.0, 61), np.arange(61) % 12 == 0), SETTINGS)
    assert states["n_epochs"].to_pylist() == [6]


def test_a_long_pass_is_cut_into_arcs():
    states = fit_states(night(2, np.arange(0.0, 1500, 50)), SETTINGS)
    assert states.num_rows == 3
    assert states["n_epochs"].to_pylist() == [13, 13, 4]


def test_an_arc_of_two_epochs_gives_no_state():
    assert fit_states(night(3, np.array([0.0, 20.0])), SETTINGS).num_rows == 0


def test_views_that_a_position_rejected_are_not_used():
    groups = night(4, np.arange(-60.0, 61, 20))
    wrong = groups.views.sensor == 0
    views = groups.views._replace(u=groups.views.u + 1e-3 * wrong[:, None])
    off, cov = errors(fit_states(groups._replace(views=views, used=~wrong), SETTINGS))
    assert off[0] @ np.linalg.solve(cov[0], off[0]) < 25


def test_no_groups_give_no_state():
    groups = night(5, np.arange(3.0))
    states = fit_states(groups.within(np.zeros(3, bool)), SETTINGS)
    assert states.equals(empty(STATES))


def test_groups_without_a_position_give_no_state():
    groups = night(5, np.arange(3.0))
    assert fit_states(groups._replace(chi2=np.full(3, np.nan)), SETTINGS).num_rows == 0


def test_a_state_whose_fit_fails_has_a_reject():
    groups = night(1, np.arange(-60.0, 61, 20), n_sensors=2)
    inward = groups.views._replace(u=-groups.views.u)
    kept, rejects = refuse_misfits(fit_states(groups._replace(views=inward), SETTINGS))
    assert kept.num_rows == 0
    assert rejects["reason"].to_pylist() == ["state_misfit"]


def test_a_state_that_does_not_fit_is_refused_and_has_a_reject():
    groups = night(1, np.arange(-60.0, 61, 20))
    states = fit_states(groups, SETTINGS)
    assert states["dof"].to_pylist() == [2 * states["n_views"][0].as_py() - 6]
    kept, rejects = refuse_misfits(states)
    assert kept.equals(states)
    assert rejects.num_rows == 0
    u = groups.views.u.copy()
    u[len(u) // 2 :, 0] += 1e-3  # another object from here on
    mixed = groups._replace(views=groups.views._replace(u=u))
    kept, rejects = refuse_misfits(fit_states(mixed, SETTINGS))
    assert kept.num_rows == 0
    assert rejects["reason"].to_pylist() == ["state_misfit"]


def objects(worse):
    """A night of six objects; the position of the first of five sensors is worse than stated."""
    return night(
        7, np.arange(-143.0, 144.0, 26.0), numbers=tuple(range(6)), worse=worse, n_sensors=5,
        noise=1.5, bias=0.0, place_km=0.02,
    )  # fmt: skip


def changed(views, other):
    """Names of the arrays that differ."""
    return {
        name
        for name, values in views._asdict().items()
        if name != "labels" and not np.array_equal(values, getattr(other, name))
    }


@pytest.mark.parametrize("worse", [30.0, 150.0])
def test_views_of_a_sensor_with_a_worse_ephemeris_have_a_larger_sigma(worse):
    """Also where it is so much worse that no state of any object fits."""
    groups = objects(worse=worse)
    honest = with_larger_errors(groups.views, judge_errors(groups, SETTINGS))
    wider = honest.sigma_km / groups.views.sigma_km
    first = groups.views.sensor == 0
    # Of this, the part that this seed drew and that the Student distribution allows.
    assert (wider[first] > 3).all()
    assert (wider[~first] < 1.5).all()
    assert changed(honest, groups.views) == {"sigma_km"}


def test_views_of_sound_sensors_keep_their_sigmas():
    groups = objects(worse=1.0)
    honest = with_larger_errors(groups.views, judge_errors(groups, SETTINGS))
    assert (honest.sigma_km / groups.views.sigma_km < 1.3).all()


def test_no_views_stay_no_views():
    groups = night(5, np.arange(3.0)).within(np.zeros(3, bool))
    errors = judge_errors(groups, SETTINGS)
    assert errors.equals(empty(SHARED_ERRORS))
    assert with_larger_errors(groups.views, errors) is groups.views


def test_only_sensors_whose_errors_are_larger_have_a_row():
    errors = judge_errors(objects(worse=150.0), SETTINGS)
    rows = {row["sensor_id"]: row for row in errors.to_pylist()}
    assert all(max(row["direction"], row["position"]) > 1.0 for row in rows.values())
    assert all(min(row["direction"], row["position"]) >= 1.0 for row in rows.values())
    assert rows["s0"]["position"] > 9.0  # of the variance: three sigma


def test_views_have_the_larger_errors_of_their_sensors():
    views = objects(worse=1.0).views
    bias = np.tile([[3e-10, 1e-10], [1e-10, 2e-10]], (len(views.sensor), 1, 1))
    views = views._replace(cov_bias=bias)
    errors = table(
        SHARED_ERRORS,
        {"sensor_id": ["s3", "absent"], "direction": [4.0, 2.0], "position": [9.0, 2.0]},
    )
    wider = with_larger_errors(views, errors)
    of_sensor = views.sensor == 3
    factor = np.where(of_sensor, 4.0, 1.0)[:, None, None]
    np.testing.assert_allclose(wider.cov_bias, bias * factor, rtol=1e-12)
    expected = views.sigma_km * np.where(of_sensor, 3.0, 1.0)
    np.testing.assert_allclose(wider.sigma_km, expected, rtol=1e-12)
    assert changed(wider, views) == {"sigma_km", "cov_bias"}

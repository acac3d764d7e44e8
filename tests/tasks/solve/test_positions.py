"""Solve positions: which rows share no detection, and honest errors of them all together."""

import itertools

import numpy as np
import pytest
from scenes.associations import filled

from epipole.schemas.bridge import (
    array,
    concat,
    stack,
    stack_covariance,
    unstack,
    unstack_covariance,
)
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.settings import PositionSettings
from epipole.schemas.spans import Span
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.algorithms.constants import ARCSEC, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.covariances import centroid_covariance, on_tangent_plane
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.orbits.orbit_fit import trajectory
from epipole.tasks.algorithms.tracking.local_motion import directions_at
from epipole.tasks.solve.pairs import pair_table
from epipole.tasks.solve.positions import position_table, solve_positions
from epipole.tasks.solve.view_groups import unpack_views

T0 = 1_554_091_200_000_000_000
SECOND_NS = 1_000_000_000
PLACE_KM = np.array([42164.0, 0.0, 0.0])
SENSORS_KM = np.array([[7000.0, 0.0, 0.0], [0.0, 7000.0, 0.0]])
PHASE_NS = np.array([0, 400_000_000])  # of each sensor's frames, which come every second


def night(n_epochs, half_s):
    """Views of one object by two sensors, every second, and the frames that each is fitted to."""
    epoch, sensor = (a.ravel() for a in np.meshgrid(np.arange(n_epochs), [0, 1], indexing="ij"))
    u = PLACE_KM - SENSORS_KM[sensor]
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    first = np.maximum(epoch - half_s, 0) * SECOND_NS + PHASE_NS[sensor]
    last = (epoch + half_s) * SECOND_NS - PHASE_NS[sensor]
    last = (last - PHASE_NS[sensor]) // SECOND_NS * SECOND_NS + PHASE_NS[sensor]
    views = filled(VIEWS, len(epoch), {
        "epoch": T0 + epoch * SECOND_NS, "sensor_id": np.array(["a", "b"])[sensor],
        "tracklet_id": np.array(["a-1", "b-1"])[sensor],
        "first_fitted": T0 + first, "last_fitted": T0 + last,
        **{f"u{a}": u[:, i] for i, a in enumerate("xyz")},
        **{f"{a}_km": SENSORS_KM[sensor, i] for i, a in enumerate("xyz")},
        **{f"cov_noise_{ab}_rad2": np.full(len(u), v) for ab, v in (("11", 1e-10), ("22", 1e-10))},
        "position_sigma_km": np.full(len(u), 0.02), "pixel_rad": np.full(len(u), 1e-4),
    })  # fmt: skip
    return views, np.zeros(len(epoch), np.int64)


def solved(views, number, span=None):
    return solve_positions(unpack_views(views, number), PositionSettings().reject_sigma, span)


def detections_of(views, positions, independent=True):
    """The detections of each position that is independent, or of each that is not."""
    kept = array(positions, "epoch")[array(positions, "independent") == independent]
    epoch, sensor = array(views, "epoch"), array(views, "sensor_id")
    first, last = array(views, "first_fitted"), array(views, "last_fitted")
    return [
        {
            (sensor[i], t)
            for i in np.flatnonzero(epoch == at)
            for t in range(first[i], last[i] + 1, SECOND_NS)
        }
        for at in kept
    ]


def test_independent_positions_share_no_detection_and_all_others_share_one():
    views, number = night(61, 6)
    positions = position_table(solved(views, number))
    used = detections_of(views, positions)
    assert all(a.isdisjoint(b) for a, b in itertools.combinations(used, 2))
    assert array(positions, "independent").sum() == len(used) == 5  # 0 to 6 s, 7 to 19 s, ...
    others = detections_of(views, positions, independent=False)
    assert all(any(a & b for b in used) for a in others)


def test_independent_positions_of_neighbouring_spans_share_no_detection():
    views, number = night(121, 6)
    used = []
    for half in (0, 1):
        span = Span(T0 + half * 60 * SECOND_NS, T0 + (half + 1) * 60 * SECOND_NS)
        used += detections_of(views, position_table(solved(views, number, span)))
    assert all(a.isdisjoint(b) for a, b in itertools.combinations(used, 2))
    assert len(used) == 9  # five, and from 60 s on four


def tracked(rng, name, sensor, target, spread_arcsec, at, t):
    """Views of an object, a state at time 0, by a sensor, another one: fitted at the times `at` to
    noisy detections at the times t [s]."""
    r_km, delay_s = trajectory(sensor, t)[0][:, :3], 0.0
    for _ in range(3):
        u = trajectory(target, t - delay_s)[0][:, :3] - r_km
        delay_s = np.linalg.norm(u, axis=1) / SPEED_OF_LIGHT_KM_S
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    noise = centroid_covariance(u, np.full(len(u), spread_arcsec * ARCSEC))
    u = u + np.einsum("ni,nij->nj", rng.normal(size=(len(u), 2)), tangent_basis(u)) * (
        spread_arcsec * ARCSEC
    )
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    ends = np.zeros(len(at), int), np.full(len(at), len(t))
    fit = directions_at(*ends, at, 0.01, t, u, noise, 0 * noise, 6.0)
    here = trajectory(sensor, at)[0]
    cov = on_tangent_plane(fit.u, fit.cov_noise)
    epoch = T0 + np.round(at * 1e9).astype(np.int64)
    return filled(VIEWS, len(at), {
        "epoch": epoch, "sensor_id": [name] * len(at), "tracklet_id": [name] * len(at),
        "first_fitted": epoch, "last_fitted": epoch, "unmodelled_rad2": fit.unmodelled,
        "blend_rad2": np.zeros(len(epoch)),
        **unstack("u{}", fit.u), **unstack("moment_{}", fit.moments, "123"),
        **unstack_covariance("cov_noise_{}_rad2", cov, TANGENT_AXES),
        **unstack("{}_km", here[:, :3]), **unstack("sensor_v{}_km_s", here[:, 3:]),
        "position_sigma_km": np.full(len(at), 1e-4), "pixel_rad": np.full(len(at), 1e-4),
    })  # fmt: skip


def from_one_satellite(seed, n_cameras, n=150):
    """Views of n objects by cameras of one satellite, and by one of another satellite.

    The error of a satellite's position is that of all its cameras. Also the true positions.
    """
    rng = np.random.default_rng(seed)
    at, other = np.array([7000.0, 0.0, 0.0]), np.array([6800.0, 1500.0, 500.0])
    true = np.array([7900.0, 800.0, 300.0]) + rng.normal(size=(n, 3)) * 50.0
    position_km, direction_rad, tables = 0.5, 2e-5, []
    shared = rng.normal(size=(n, 3)) * position_km
    for k in range(n_cameras + 1):
        r_km, error = (at, shared) if k else (other, rng.normal(size=(n, 3)) * position_km)
        u = true - r_km
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        noise = rng.normal(size=(n, 2)) * direction_rad
        u += np.einsum("ni,nij->nj", noise, tangent_basis(u))
        tables.append(filled(VIEWS, n, {
            "epoch": np.full(n, T0), "sensor_id": [f"s{k}"] * n,
            "tracklet_id": [f"s{k}-{m}" for m in range(n)],
            "first_fitted": np.full(n, T0), "last_fitted": np.full(n, T0),
            **unstack("u{}", u / np.linalg.norm(u, axis=1, keepdims=True)),
            **unstack("{}_km", r_km + error),
            **{f"cov_noise_{ab}_rad2": np.full(n, direction_rad**2) for ab in ("11", "22")},
            "position_sigma_km": np.full(n, position_km), "pixel_rad": np.full(n, 1e-4),
        }))  # fmt: skip
    return concat(VIEWS, tables), np.tile(np.arange(n), n_cameras + 1), true


@pytest.mark.parametrize("n_cameras", [1, 2, 4])
def test_the_error_of_a_satellites_position_counts_once_for_all_its_cameras(n_cameras):
    views, number, true = from_one_satellite(n_cameras, n_cameras)
    groups = solved(views, number)
    off = groups.x_km - true[groups.views.object_number[groups.offsets[:-1]]]
    square = np.einsum("ni,nij,nj->n", off, np.linalg.inv(groups.cov_km2), off)
    assert abs(square.mean() / 3 - 1) < 0.25  # four sigma of the mean


def turning(seed, spread_arcsec):
    """Views of a geostationary object from three low sensors, fitted to 13 noisy detections each.

    Its true positions are returned too.
    """
    rng = np.random.default_rng(seed)
    at, t = np.arange(-52.0, 53.0, 13.0), np.arange(-58.0, 59.0)
    target = np.array([36000.0, 21900.0, 0.0, -1.6, 2.63, 0.0])
    tables = []
    for k in range(3):
        angle = rng.uniform(0, 2 * np.pi)
        side = np.array([0.6 * np.sin(angle), -np.sin(angle), np.cos(angle)])
        side /= np.linalg.norm(side)
        sensor = np.concatenate([7000 * side, 7.5 * np.cross(side, [0.8, 0.6, 0.0])])
        tables.append(tracked(rng, f"s{k}", sensor, target, spread_arcsec, at, t))
    return concat(VIEWS, tables), lambda s: trajectory(target, s)[0][:, :3]


def test_what_the_fits_of_directions_neglect_does_not_add_up():
    """A low sensor bends towards the Earth in every fit, so the error would be one of all rows."""
    mean_off, square = [], []
    for seed in range(40):
        views, true = turning(seed, 1.5)
        positions = position_table(solved(views, np.zeros(views.num_rows, int)))
        at = (array(positions, "time") - T0) / 1e9
        off, cov = stack(positions, "{}_km") - true(at), stack_covariance(positions, "cov_{}")
        square.append(np.mean(np.einsum("ni,nij,nj->n", off, np.linalg.inv(cov), off)) / 3)
        mean = off.mean(axis=0)
        mean_off.append(mean @ np.linalg.solve(cov.mean(axis=0) / len(off), mean) / 3)
    assert abs(np.mean(square) - 1) < 0.13
    assert abs(np.mean(mean_off) - 1) < 0.39  # three sigma of 40 trials with three axes


PAIR_KM = 0.3  # between two low sensors


def left_by_the_far_one(seed):
    """Views of a low object by two low sensors side by side, and until 0 s by a geostationary one.

    Its true positions are returned too.
    """
    rng, at, t = np.random.default_rng(seed), np.arange(-50.0, 51.0, 2.0), np.arange(-58.0, 59.0)
    target = np.array([7800.0, 600.0, 900.0, -1.5, 6.9, 0.5])
    low = np.array([6900.0, 0.0, 0.0, 0.0, 5.5, 5.2])
    far = np.array([16000.0, 36000.0, 9000.0, -2.7, 1.2, 0.0])
    beside = low + PAIR_KM * np.array([0.0, 0.6, 0.8, 0.0, 0.0, 0.0])
    tables = [
        tracked(rng, f"low{k}", state, target, 2.0, at, t) for k, state in enumerate((low, beside))
    ]
    tables.append(tracked(rng, "far", far, target, 0.3, at[at <= 0], t[t <= 0]))
    return concat(VIEWS, tables), lambda s: trajectory(target, s)[0][:, :3]


def squared_errors(seeds, from_s, to_s):
    """The mean squared error over covariance of the positions between two times."""
    square = []
    for seed in range(seeds):
        views, true = left_by_the_far_one(seed)
        positions = position_table(solved(views, np.zeros(views.num_rows, int)))
        epoch_s, at = ((array(positions, name) - T0) / 1e9 for name in ("epoch", "time"))
        off, cov = stack(positions, "{}_km") - true(at), stack_covariance(positions, "cov_{}")
        here = (epoch_s >= from_s) & (epoch_s <= to_s)
        square.append(np.einsum("ni,nij,nj->n", off, np.linalg.inv(cov), off)[here])
    return np.mean(np.concatenate(square)) / 3


def test_positions_are_honest_before_their_velocity_is_known():
    """Without it light times put the far sensor's line 30 sigma off. It is not rejected for that:
    the two others alone, side by side, know the velocity badly."""
    assert 0.8 < squared_errors(20, -50, -31) < 1.2


def test_a_velocity_is_that_of_the_good_positions():
    """The far sensor leaves. From then on the range has an error of 80 km."""
    assert 0.8 < squared_errors(20, -30, 0) < 1.2


def seen_once(rng, rates=True):
    """Views at one epoch of a low object, by a low sensor and a geostationary one; where it is.

    The two see it where it was 0.005 s and 0.14 s before.
    """
    r_km = np.array([[6000.0, 4200.0, 300.0], [-20000.0, 36000.0, 9000.0]])
    v_km_s = np.array([[-3.0, 4.0, 5.0], [-2.7, -1.5, 0.0]])
    x_km, velocity = np.array([5600.0, 4900.0, 1500.0]), np.array([-4.2, 1.5, 6.0])
    sigma, fitted_s = np.array([5.0, 2.0]) * ARCSEC, 6.0
    delay_s = np.linalg.norm(x_km - r_km, axis=1)[:, None] / SPEED_OF_LIGHT_KM_S
    path = x_km - velocity * delay_s - r_km
    range_km = np.linalg.norm(path, axis=1, keepdims=True)
    u = path / range_km
    across = (velocity - v_km_s) / range_km
    w = across - np.sum(u * across, axis=1, keepdims=True) * u
    basis = tangent_basis(u)
    noise = rng.normal(size=(2, 2, 2)) * sigma[:, None]
    u = u + np.einsum("na,nai->ni", noise[0], basis)
    w = w + np.einsum("na,nai->ni", noise[1] * np.sqrt(12) / fitted_s, basis)
    half_ns = round(fitted_s / 2 * 1e9)
    views = filled(VIEWS, 2, {
        "epoch": [T0, T0], "sensor_id": ["a", "b"], "tracklet_id": ["a-1", "b-1"],
        "first_fitted": [T0 - half_ns] * 2, "last_fitted": [T0 + half_ns] * 2,
        **unstack("u{}", u / np.linalg.norm(u, axis=1, keepdims=True)),
        **unstack("w{}_rad_s", w * rates), **unstack("{}_km", r_km),
        **unstack("sensor_v{}_km_s", v_km_s),
        **{f"cov_noise_{ab}_rad2": sigma**2 for ab in ("11", "22")},
        "position_sigma_km": [0.01] * 2, "pixel_rad": [1e-4] * 2,
    })  # fmt: skip
    return views, x_km - velocity * delay_s.mean()


def test_a_single_position_is_honest_where_light_times_differ():
    rng, errors = np.random.default_rng(5), []
    for _ in range(400):
        views, true_km = seen_once(rng)
        position = position_table(solved(views, np.zeros(2, np.int64)))
        off = stack(position, "{}_km") - true_km
        covariance = stack_covariance(position, "cov_{}")
        errors.append((off @ np.linalg.solve(covariance, off[:, :, None])[0]).item() / 3)
    assert 0.9 < np.mean(errors) < 1.1


def test_a_position_without_rates_takes_the_object_as_at_rest():
    views, _ = seen_once(np.random.default_rng(6), rates=False)
    assert not solved(views, np.zeros(2, np.int64)).velocity_km_s.any()


def views_of_five(miss=None):
    """Views of one object at one epoch by five sensors; the fourth has the smallest error."""
    angle = np.linspace(-1.2, 1.2, 5)
    r = 7000.0 * np.column_stack([np.cos(angle), np.sin(angle), 0.3 * angle])
    u = PLACE_KM - r
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    variance = np.array([4.0, 4.0, 4.0, 1.0, 2.0]) * 1e-10
    return filled(VIEWS, 5, {
        "epoch": np.full(5, T0), "sensor_id": list("abcde"), "frame_number": np.arange(5),
        "tracklet_id": [f"{s}-1" for s in "abcde"],
        "centroid": [None if s == miss else 7 for s in "abcde"],
        "first_fitted": np.full(5, T0), "last_fitted": np.full(5, T0),
        **unstack("u{}", u), **unstack("{}_km", r),
        **{f"cov_noise_{ab}_rad2": variance for ab in ("11", "22")},
        "position_sigma_km": np.full(5, 0.02), "pixel_rad": np.full(5, 1e-4),
    }), np.zeros(5, np.int64)  # fmt: skip


def test_pairs_are_each_view_with_the_one_of_the_least_error():
    pairs = pair_table(solved(*views_of_five()), all_pairs=False)
    assert pairs["sensor_id_1"].to_pylist() == ["d"] * 4
    assert sorted(pairs["sensor_id_2"].to_pylist()) == ["a", "b", "c", "e"]
    missed = pair_table(solved(*views_of_five(miss="d")), all_pairs=False)
    assert missed["sensor_id_1"].to_pylist() == ["e"] * 3


def test_all_pairs_are_every_two_views():
    pairs = pair_table(solved(*views_of_five()), all_pairs=True)
    rows = zip(pairs["sensor_id_1"].to_pylist(), pairs["sensor_id_2"].to_pylist(), strict=True)
    assert sorted(rows) == list(itertools.combinations("abcde", 2))

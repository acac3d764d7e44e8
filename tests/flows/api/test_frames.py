"""One frame: stars and attitude against the truth of a simulated log."""

import numpy as np
import polars as pl
import pytest

from epipole.flows import api
from epipole.flows.simulate import simulate
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.camera import project
from epipole.tasks.algorithms.geometry.directions import (
    aberrate,
    matrix_from_quaternion,
    tangent_basis,
)

STAR = 0  # the kind of a point in the truth
CAMERA = api.Camera(512, 512, 14666.0, 14666.0, 255.5, 255.5)


@pytest.fixture(scope="module")
def lost(tmp_path_factory):
    """Return a log without prior attitudes, and its truth: frames and points."""
    where = tmp_path_factory.mktemp("lost") / "lost.mcap"
    simulate("lost_in_space", where, seed=3)
    folder = where.with_name(where.name + ".truth")
    return (
        api.read_log(where),
        *(pl.read_parquet(folder / f"{name}.parquet") for name in ("frames", "points")),
    )


def camera_of(log, sensor_id):
    row = log.cameras.filter(pl.col("sensor_id") == sensor_id)
    return api.Camera(**row.select(api.Camera._fields).row(0, named=True))


def test_frames_are_identified_as_the_truth_says(lost):
    log, frames, points = lost
    identified, whitened = 0, []
    chosen = log.frames.gather_every(max(log.frames.height // 12, 1)).head(12)
    for frame in chosen.to_dicts():
        key = [pl.col(name) == frame[name] for name in ("sensor_id", "frame_number")]
        truth = frames.filter(*key).row(0, named=True)
        found = api.identify_frame(
            frame["x_px"],
            frame["y_px"],
            frame["flux"],
            camera=camera_of(log, frame["sensor_id"]),
            time=frame["time"],
            sigma_px=frame["sigma_px"],
            velocity_km_s=[truth["vx"], truth["vy"], truth["vz"]],
        )
        if found.status is not None:
            assert found.source == "none"
            assert np.isnan(found.attitude_xyzw).all()
            continue
        identified += 1
        true = points.filter(*key).sort("centroid")
        star = np.where(true["kind"] == STAR, true["source"], -1)
        wrong = (found.star_id >= 0) & (found.star_id != star)
        assert not wrong.any()
        assert (found.star_id >= 0).sum() >= 0.8 * (star >= 0).sum()
        R = matrix_from_quaternion(found.attitude_xyzw[None])[0]
        R_true = matrix_from_quaternion(np.array([[truth[f"q{a}"] for a in "xyzw"]]))[0]
        turn = R @ R_true.T
        error = np.array(
            [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
        )
        error /= 2 * ARCSEC
        whitened.append(error @ np.linalg.solve(found.attitude_cov_arcsec2, error))
    assert identified >= 10
    # The mean of 10 to 12 chi-squares of 3 degrees of freedom: 3, with a sigma of 0.75.
    assert 1.0 < np.mean(whitened) < 6.0


def test_an_unknown_velocity_is_in_the_covariance(lost):
    log, frames, _ = lost
    frame = log.frames.row(0, named=True)
    truth = frames.filter(*[pl.col(n) == frame[n] for n in ("sensor_id", "frame_number")])
    known, unknown = (
        api.identify_frame(
            frame["x_px"], frame["y_px"], frame["flux"], sigma_px=frame["sigma_px"],
            camera=camera_of(log, frame["sensor_id"]), time=frame["time"], velocity_km_s=velocity,
        )
        for velocity in (truth.select("vx", "vy", "vz").row(0), None)
    )  # fmt: skip
    assert known.source == unknown.source == "stars"
    added = (unknown.attitude_cov_arcsec2 - known.attitude_cov_arcsec2)[:2, :2]
    np.testing.assert_allclose(added, 9.1 * np.eye(2), atol=0.3)
    about = unknown.attitude_cov_arcsec2[2, 2] / known.attitude_cov_arcsec2[2, 2]
    assert about == pytest.approx(1.0, rel=0.01)


def test_a_prior_is_used_where_there_are_too_few_stars():
    prior = [0.0, 0.6, 0.0, 0.8]
    found = api.identify_frame(
        [1.0], [2.0], camera=CAMERA, time="2019-04-01", prior_xyzw=prior, prior_sigma_arcsec=30.0
    )
    assert (found.source, found.status) == ("prior", "too_few_stars")
    assert found.star_id.tolist() == [-1]
    np.testing.assert_allclose(found.attitude_xyzw, prior)
    np.testing.assert_allclose(found.attitude_cov_arcsec2, 900.0 * np.eye(3))


def test_an_empty_frame_is_no_error():
    found = api.identify_frame([], [], camera=CAMERA, time="2019-04-01")
    assert (found.source, found.status, len(found.star_id)) == ("none", "no_centroids", 0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"y_px": [1.0]}, r"y_px: has shape \(1,\), expected \(2,\)"),
        ({"flux": [1.0]}, r"flux: has shape \(1,\), expected \(2,\)"),
        ({"x_px": [[1.0, 2.0]]}, r"x_px: has shape \(1, 2\), expected \(n,\)"),
        ({"velocity_km_s": [7.5]}, r"velocity_km_s: has shape \(1,\), expected \(3,\)"),
        ({"prior_xyzw": [1.0, 1.0, 1.0, 1.0]}, "prior_xyzw: has length 2, expected a unit"),
        ({"prior_sigma_arcsec": -30.0}, "prior_sigma_arcsec: is -30, expected 0 or more"),
        ({"prior_sigma_arcsec": float("nan")}, "prior_sigma_arcsec: is nan, expected 0 or more"),
        ({"prior_sigma_arcsec": [3.0, 3.0]}, r"prior_sigma_arcsec: has shape \(2,\), expected"),
        ({"velocity_km_s": [7500.0, 0.0, 0.0]}, "velocity_km_s: 7500 km/s, .* is it in m/s"),
        ({"velocity_km_s": [None] * 3}, "velocity_km_s: is .*; give None where it is unknown"),
        ({"velocity_km_s": [7.5, np.nan, 0.0]}, "velocity_km_s: is .*, expected numbers"),
        ({"time": "noon"}, "time: "),
        ({"time": 2**70}, "time: "),
    ],
)
def test_wrong_arguments_of_a_frame_are_named(change, message):
    arguments = {"x_px": [1.0, 2.0], "y_px": [1.0, 2.0], "camera": CAMERA} | change
    arguments = {"time": "2019-04-01"} | arguments
    with pytest.raises(ValueError, match=message):
        api.identify_frame(**arguments)


@pytest.mark.parametrize("attitude", [np.zeros(4), np.full(4, np.nan), [0.0, 0.0, 0.0, 2.0]])
def test_a_view_without_an_attitude_is_an_error(attitude):
    where = {"position_km": [7000.0, 0.0, 0.0], "velocity_km_s": np.zeros(3)}
    with pytest.raises(ValueError, match="attitude_xyzw: has length"):
        api.view_frame([1.0], [1.0], camera=CAMERA, attitude_xyzw=attitude, sigma_px=0.1, **where)


@pytest.mark.parametrize("velocity", [None, [None] * 3])
def test_a_view_needs_a_velocity(velocity):
    with pytest.raises(ValueError, match="velocity_km_s"):
        api.view_frame(
            [1.0], [1.0], camera=CAMERA, attitude_xyzw=[0.0, 0.0, 0.0, 1.0], sigma_px=0.1,
            position_km=[7000.0, 0.0, 0.0], velocity_km_s=velocity,
        )  # fmt: skip


@pytest.mark.parametrize("sigma_px", [-0.1, [0.1, None]])
def test_a_view_needs_errors_of_its_centroids(sigma_px):
    with pytest.raises(ValueError, match="sigma_px: has values that are below 0, or no numbers"):
        api.view_frame(
            [1.0, 2.0], [1.0, 2.0], camera=CAMERA, attitude_xyzw=[0.0, 0.0, 0.0, 1.0],
            sigma_px=sigma_px, position_km=[7000.0, 0.0, 0.0], velocity_km_s=[0.0, 7.5, 0.0],
        )  # fmt: skip


def test_directions_come_back_with_the_scatter_of_their_covariance():
    rng = np.random.default_rng(5)
    q = np.array([0.3, -0.2, 0.5, 0.78])
    q /= np.linalg.norm(q)
    R = matrix_from_quaternion(q[None])[0]
    velocity = np.array([0.0, 7.5, 0.1])
    along = rng.normal(size=(400, 3)) * [0.01, 0.01, 0] + [0, 0, 1]
    u_true = (along / np.linalg.norm(along, axis=1, keepdims=True)) @ R
    x, y = project(CAMERA, aberrate(u_true, velocity) @ R.T)
    sigma = rng.uniform(0.1, 0.4, 400)
    view = api.view_frame(
        x + rng.normal(size=400) * sigma,
        y + rng.normal(size=400) * sigma,
        camera=CAMERA,
        attitude_xyzw=q,
        position_km=[7000.0, 0.0, 0.0],
        velocity_km_s=velocity,
        sigma_px=sigma,
    )
    off = np.einsum("nai,ni->na", tangent_basis(view.u_icrs), u_true - view.u_icrs)
    chi2 = np.einsum("na,nab,nb->n", off, np.linalg.inv(view.cov_rad2), off)
    assert chi2.mean() == pytest.approx(2.0, abs=0.5)  # five sigma of 400 draws


def test_an_error_of_the_attitude_is_in_the_covariance():
    common = {"camera": CAMERA, "attitude_xyzw": [0, 0, 0, 1], "sigma_px": 1e-9,
              "position_km": [7e3, 0, 0], "velocity_km_s": [0, 0, 0]}  # fmt: skip
    view = api.view_frame([255.5], [255.5], attitude_cov_arcsec2=np.diag([4.0, 9.0, 1e4]), **common)
    variances = np.linalg.eigvalsh(view.cov_rad2[0]) / ARCSEC**2
    np.testing.assert_allclose(variances, [4.0, 9.0], rtol=1e-6)

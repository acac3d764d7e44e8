"""View objects: honest errors where the attitude is a prior, whether it is off or scatters."""

import numpy as np
import pytest
from scenes.associations import filled

from epipole.schemas.bridge import stack, stack_covariance, unstack
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.settings import Settings
from epipole.schemas.tables import DETECTIONS, EPOCHS
from epipole.schemas.work_tables import CAMERAS, SOLUTIONS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.rotations import quaternion_from_matrix
from epipole.tasks.algorithms.geometry.sky import radec_from_unit, tangent_basis, unit_from_radec
from epipole.tasks.solve.view_objects import view_objects

T0 = 1_554_091_200_000_000_000
N_FRAMES, N_OBJECTS = 61, 4
CENTROID, STATED = 4.0, 35.0  # [arcsec]
RATE = 40 * ARCSEC  # [rad/s]
APART_S = 13  # epochs so far apart share no detection


def views_of_priors(seed, white, constant):
    """Views of objects by one sensor with prior attitudes, and the errors of their directions.

    The attitude's error is a constant and one that changes from frame to frame [arcsec].
    """
    rng = np.random.default_rng(seed)
    frame, item = (a.ravel() for a in np.meshgrid(range(N_FRAMES), range(N_OBJECTS), indexing="ij"))
    start = unit_from_radec(np.zeros(N_OBJECTS), np.linspace(-0.02, 0.02, N_OBJECTS))
    east, north = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    true = start[item] + np.outer(frame * RATE, east)
    turn = rng.normal(size=(N_FRAMES, 2)) * white + rng.normal(size=2) * constant
    off = (turn[frame] + rng.normal(size=(len(frame), 2)) * CENTROID) * ARCSEC
    ra, dec = radec_from_unit(true + off @ np.array([east, north]))
    time = T0 + np.arange(N_FRAMES) * 1_000_000_000
    name = np.array([f"t{k}" for k in range(N_OBJECTS)])
    key = {"sensor_id": ["s"] * N_FRAMES, "frame_number": np.arange(N_FRAMES)}
    # The sensor looks along x of the ICRS.
    q = quaternion_from_matrix(np.tile(np.roll(np.eye(3), 1, axis=1), (N_FRAMES, 1, 1)))
    solutions = filled(SOLUTIONS, N_FRAMES, key | unstack("q{}", q, "xyzw") | {
        "time": time, "attitude_source": ["prior"] * N_FRAMES,
        **{f"cov_att_{ab}_arcsec2": np.full(N_FRAMES, STATED**2 * (ab[0] == ab[1]))
           for ab in ("xx", "xy", "xz", "yy", "yz", "zz")},
        "x_km": np.full(N_FRAMES, 7000.0), **{f"{a}_km": np.zeros(N_FRAMES) for a in "yz"},
        **{f"v{a}_km_s": np.zeros(N_FRAMES) for a in "xyz"},
        "used_position_sigma_km": np.full(N_FRAMES, 0.02),
    })  # fmt: skip
    detections = filled(DETECTIONS, len(frame), {
        "sensor_id": ["s"] * len(frame), "frame_number": frame, "time": time[frame],
        "centroid": item, "ra_deg": np.degrees(ra), "dec_deg": np.degrees(dec),
        "sigma_arcsec": np.full(len(frame), CENTROID), "kind": ["object"] * len(frame),
        "tracklet_id": name[item], "track_id": name[item],
    })  # fmt: skip
    epochs = filled(EPOCHS, N_FRAMES, key | {"epoch": time, "dt_s": np.zeros(N_FRAMES)})
    camera = filled(CAMERAS, 1, {
        "sensor_id": ["s"], "width": [1024], "height": [1024], "fx_px": [7300.0], "fy_px": [7300.0],
        "cx_px": [511.5], "cy_px": [511.5],
    })  # fmt: skip
    views = view_objects(epochs, solutions, detections, camera, Settings())
    views = views.sort_by([("tracklet_id", "ascending"), ("epoch", "ascending")])
    order = np.lexsort((frame, item))
    return views, stack(views, "u{}") - true[order] / np.linalg.norm(true[order], axis=1)[:, None]


@pytest.mark.parametrize(("white", "constant"), [(35.0, 0.0), (20.0, 28.7), (0.0, 35.0)])
def test_the_error_of_a_prior_is_divided_as_the_detections_show(white, constant):
    noise, total = [], []
    for seed in range(60):
        views, off = views_of_priors(seed, white, constant)
        shape = (N_OBJECTS, N_FRAMES)
        rows = np.arange(views.num_rows).reshape(shape)[:, 7:-6:APART_S].ravel()
        basis = tangent_basis(stack(views, "u{}"))
        e = np.einsum("nij,nj->ni", basis, off)[rows].reshape(N_OBJECTS, -1, 2)
        cov = {}
        for which in ("noise", "bias"):
            of_views = stack_covariance(views, f"cov_{which}_{{}}_rad2", TANGENT_AXES)
            cov[which] = of_views[rows].mean(axis=0)
        mean = e.mean(axis=1, keepdims=True)
        scatter = np.sum((e - mean) ** 2) / (2 * N_OBJECTS * (e.shape[1] - 1))
        noise.append(scatter / np.trace(cov["noise"]) * 2)
        total.append(np.mean(e**2) / np.trace(cov["noise"] + cov["bias"]) * 2)
    # Objects of one frame share the attitude's error: 60 trials of 4 epochs and two axes.
    assert abs(np.mean(noise) - 1) < 0.2
    if constant:
        assert abs(np.mean(total) - 1) < 0.45
    else:  # where all scatters, nothing stays, but 61 frames tell that to an eighth only
        assert 0.2 < np.mean(total) < 1.3


def test_attitudes_that_do_not_scatter_are_not_divided():
    views, _ = views_of_priors(1, 0.0, 35.0)
    bias = stack_covariance(views, "cov_bias_{}_rad2", TANGENT_AXES)
    np.testing.assert_allclose(np.sqrt(bias[:, 0, 0]) / ARCSEC, STATED, rtol=0.05)

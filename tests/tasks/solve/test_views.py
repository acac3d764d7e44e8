"""View objects: honest errors where the attitude is a prior, whether it is off or scatters."""

import numpy as np
import pyarrow as pa
import pytest
from scenes.associations import filled
from scenes.cameras import cameras_of

from epipole.schemas.bridge import array, stack, stack_covariance, unstack
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.settings import AlignmentSettings, TrackletSettings
from epipole.schemas.tables import DETECTIONS, EPOCHS
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.algorithms.geometry.directions import (
    quaternion_from_matrix,
    radec_from_unit,
    tangent_basis,
    unit_from_radec,
)
from epipole.tasks.solve.sightings import sight_objects
from epipole.tasks.solve.views import view_objects

T0 = 1_554_091_200_000_000_000
N_FRAMES, N_OBJECTS = 61, 4
CENTROID, STATED = 4.0, 35.0  # [arcsec]
PIXEL = 1 / 3000  # [rad]
CAMERA = Camera(1024, 1024, 1 / PIXEL, 1 / PIXEL, 511.5, 511.5)
RATE = 40 * ARCSEC  # [rad/s]
ZERO_MAG = 20.0
APART_S = 13  # epochs so far apart share no detection


HALF_WIDTH_S = AlignmentSettings().window_s


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
    seen = {"frame": frame, "item": item, "u": true + off @ np.array([east, north])}
    views = views_of(seen, "prior", np.full(len(frame), np.nan))
    order = np.lexsort((frame, item))
    return views, stack(views, "u{}") - true[order] / np.linalg.norm(true[order], axis=1)[:, None]


def views_of(seen, source, flux, cov_optics=None, cameras=None, camera=0):
    """Views of objects by a sensor that looks along x of the ICRS, errors of its optics or not.

    `seen` has the frame, the number of the object and the direction of each detection; `camera`
    the row of `cameras` of each frame.
    """
    frame, item = seen["frame"], seen["item"]
    ra, dec = radec_from_unit(seen["u"])
    stated = STATED if source == "prior" else 1.0
    time = T0 + np.arange(N_FRAMES) * 1_000_000_000
    name = np.array([f"t{k}" for k in range(item.max() + 1)])
    key = {"sensor_id": ["s"] * N_FRAMES, "frame_number": np.arange(N_FRAMES)}
    q = quaternion_from_matrix(np.tile(np.roll(np.eye(3), 1, axis=1), (N_FRAMES, 1, 1)))
    solutions = filled(SOLUTIONS, N_FRAMES, key | unstack("q{}", q, "xyzw") | {
        "time": time, "attitude_source": [source] * N_FRAMES,
        "camera": np.broadcast_to(camera, N_FRAMES), "n_stars": np.full(N_FRAMES, 100),
        **{f"cov_att_{ab}_arcsec2": np.full(N_FRAMES, stated**2 * (ab[0] == ab[1]))
           for ab in ("xx", "xy", "xz", "yy", "yz", "zz")},
        "x_km": np.full(N_FRAMES, 7000.0), **{f"{a}_km": np.zeros(N_FRAMES) for a in "yz"},
        **{f"v{a}_km_s": np.zeros(N_FRAMES) for a in "xyz"},
        "used_position_sigma_km": np.full(N_FRAMES, 0.02), "zero_mag": np.full(N_FRAMES, ZERO_MAG),
        **{f"{a}_mag2": np.zeros(N_FRAMES) for a in ("zero_variance", "flux_floor", "flux_photon")},
    })  # fmt: skip
    detections = filled(DETECTIONS, len(frame), {
        "sensor_id": ["s"] * len(frame), "frame_number": frame, "time": time[frame],
        "centroid": item, "ra_deg": np.degrees(ra), "dec_deg": np.degrees(dec),
        "sigma_arcsec": np.full(len(frame), CENTROID), "kind": ["object"] * len(frame),
        "tracklet_id": name[item], "track_id": name[item], "flux": flux,
    })  # fmt: skip
    epochs = filled(EPOCHS, N_FRAMES, key | {"epoch": time, "dt_s": np.zeros(N_FRAMES)})
    if cameras is None:
        cameras = cameras_of({"s": CAMERA}, cov_optics)
    sighted = sight_objects(solutions, detections, cameras, TrackletSettings(), HALF_WIDTH_S)
    views = view_objects(epochs, sighted, TrackletSettings().max_rate_deg_s, HALF_WIDTH_S)
    return views.sort_by([("tracklet_id", "ascending"), ("epoch", "ascending")])


@pytest.mark.long
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


def views_of_a_blend(seed):
    """Views of an object that a neighbour passes at 0.4 px, and the errors of their directions.

    Nearer than 1.5 px, their light is one centroid, which the object's tracklet has.
    """
    rng, t = np.random.default_rng(seed), np.arange(N_FRAMES)
    east, north = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])
    path = np.array([1.0, 0.0, 0.0]) + np.outer(t * RATE, east)
    apart = np.outer((t - 30) * 0.12, east) + 0.4 * north  # [px]
    one = np.linalg.norm(apart, axis=1) < 1.5
    first = path + np.where(one[:, None], 0.6 * apart, 0.0) * PIXEL
    second = path + apart * PIXEL
    before, after = np.flatnonzero(~one & (t < 30)), np.flatnonzero(~one & (t > 30))
    frame = np.concatenate([t, before, after])
    item = np.repeat([0, 1, 2], [len(t), len(before), len(after)])
    u = np.concatenate([first, second[before], second[after]])
    u += rng.normal(size=(len(u), 2)) * CENTROID * ARCSEC @ np.array([east, north])
    flux = np.where(item > 0, 60.0, np.where(one[frame], 100.0, 40.0))
    order = np.lexsort((item, frame))
    seen = {"frame": frame[order], "item": item[order], "u": u[order]}
    views = views_of(seen, "stars", flux[order])
    off = stack(views, "u{}")[:N_FRAMES] - path / np.linalg.norm(path, axis=1)[:, None]
    return views.slice(0, N_FRAMES), off, one


@pytest.mark.parametrize("seed", range(4))
def test_a_neighbour_s_light_widens_the_error_of_the_views_it_touches(seed):
    views, off, one = views_of_a_blend(seed)
    basis = tangent_basis(stack(views, "u{}"))
    e = np.einsum("nij,nj->ni", basis, off)
    cov = stack_covariance(views, "cov_noise_{}_rad2", TANGENT_AXES)
    far = np.abs(np.arange(N_FRAMES) - 30) > 25
    blend = array(views, "blend_rad2")
    assert (blend[far] == 0).all()
    assert (blend[one] > 0).all()
    square = np.einsum("ni,nij,nj->n", e, np.linalg.inv(cov), e)
    assert square.max() < 14  # 0.1 % of honest ones
    # Without what the blend adds, some would be far outside their covariance.
    own = np.trace(cov, axis1=1, axis2=2) / 2 - blend
    assert (np.sum(e**2, axis=1) / own).max() > 30


@pytest.mark.parametrize(
    ("number", "sigma", "in_stars_px", "in_prior_px"),
    [(2, 5.0, 0.0, 5.0), (0, 30.0, 2.2, 2.2)],  # principal point; focal length, 1 %
)
def test_what_the_attitude_does_not_compensate_of_the_optics_is_a_bias(
    number, sigma, in_stars_px, in_prior_px
):
    """An object 220 px from the middle of the image, along columns."""
    t = np.arange(N_FRAMES)
    at = np.array([1.0, 220 * PIXEL, 0.0]) + np.outer(t * 1e-9, [0.0, 1.0, 0.0])
    seen = {"frame": t, "item": np.zeros(N_FRAMES, int), "u": at}
    cov_optics = np.zeros((9, 9))
    cov_optics[number, number] = sigma**2
    for source, expected_px in (("stars", in_stars_px), ("prior", in_prior_px)):
        bias = [
            stack_covariance(
                views_of(seen, source, np.full(N_FRAMES, np.nan), cov), "cov_bias_{}_rad2",
                TANGENT_AXES,
            )
            for cov in (np.zeros((9, 9)), cov_optics)
        ]  # fmt: skip
        added_px = np.sqrt(np.trace(bias[1] - bias[0], axis1=1, axis2=2)) / PIXEL
        np.testing.assert_allclose(added_px, expected_px, atol=0.15)


BINNED = Camera(512, 512, 1 / PIXEL / 2, 1 / PIXEL / 2, 255.5, 255.5)  # from frame 30 on


def test_after_a_change_of_calibration_views_are_in_the_image_of_their_frame():
    t = np.arange(N_FRAMES)
    at = np.array([1.0, 220 * PIXEL, 0.0]) + np.outer(t * 1e-9, [0.0, 1.0, 0.0])
    seen = {"frame": t, "item": np.zeros(N_FRAMES, int), "u": at}
    cov_optics = np.zeros((9, 9))
    cov_optics[2, 2] = 5.0**2  # principal point, after the change [px]
    cameras = pa.concat_tables(
        [cameras_of({"s": CAMERA}), cameras_of({"s": BINNED}, cov_optics)]
    )  # fmt: skip
    late = t >= 30
    flux = np.full(N_FRAMES, np.nan)
    views = views_of(seen, "prior", flux, cameras=cameras, camera=late.astype(int))
    expected = {name: np.where(late, b, a) for name, a, b in [
        ("x_px", 731.5, 365.5), ("y_px", 511.5, 255.5), ("pixel_rad", PIXEL, 2 * PIXEL),
        ("field_part", 5, 5),
    ]}  # fmt: skip
    for name, values in expected.items():
        np.testing.assert_allclose(array(views, name), values, atol=0.01, err_msg=name)
    bias = stack_covariance(views, "cov_bias_{}_rad2", TANGENT_AXES)
    added = np.trace(bias, axis1=1, axis2=2)[late] - np.trace(bias[0])
    np.testing.assert_allclose(np.sqrt(added) / (2 * PIXEL), 5.0, atol=0.3)


def test_a_view_has_the_mean_magnitude_of_its_detections_without_blended_ones():
    views, _, one = views_of_a_blend(0)
    magnitude = views["magnitude"].to_numpy(zero_copy_only=False)
    alone = array(views, "blend_rad2") == 0
    np.testing.assert_allclose(magnitude[alone], ZERO_MAG - 2.5 * np.log10(40.0))
    middle = np.abs(np.arange(N_FRAMES) - 30) < 5
    assert np.isnan(magnitude[middle & one]).all()  # a minute of blends has none that is not
    still = {"frame": np.arange(N_FRAMES), "item": np.zeros(N_FRAMES, int),
             "u": np.tile([1.0, 0.0, 0.0], (N_FRAMES, 1))}  # fmt: skip
    assert views_of(still, "stars", np.full(N_FRAMES, np.nan))["magnitude"].null_count == N_FRAMES

"""Sightings as observations: covariances of the sky's axes, what is shared, what is unknown."""

import numpy as np
import pytest
from scenes.associations import filled
from scenes.cameras import cameras_of
from scipy.spatial.transform import Rotation

from epipole.schemas.bridge import array, unstack, unstack_covariance
from epipole.schemas.settings import AlignmentSettings, TrackletSettings
from epipole.schemas.spans import Span
from epipole.schemas.tables import DETECTIONS
from epipole.schemas.work_tables import SOLUTIONS, TRACKLET_RUNS
from epipole.tasks.algorithms.constants import ARCSEC, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.camera import Camera, unproject
from epipole.tasks.algorithms.geometry.directions import radec_from_unit
from epipole.tasks.algorithms.orbits.orbit_fit import trajectory
from epipole.tasks.solve.sightings import (
    sight_objects,
    states_near_frames,
    tabulate_attributables,
    tabulate_sightings,
    with_middle_in,
)

T0 = 1_554_091_200_000_000_000
N = 40
CAMERA = Camera(1024, 1024, 3000.0, 3000.0, 511.5, 511.5)
CENTROID = 2.0  # [arcsec]
COV_ATT = np.array([[9.0, 2.0, 5.0], [2.0, 4.0, -3.0], [5.0, -3.0, 400.0]])  # [arcsec^2], sensor
ATTITUDE = Rotation.from_euler("zyx", [0.3, -0.9, 1.1])  # sensor from ICRS
PLACE_PX = (820.0, 130.0)
V_KM_S = np.array([3.0, -6.0, 2.5])


HALF_WIDTH_S = AlignmentSettings().window_s


def sighted(source="stars", *, tracklet="t", flux=np.nan, cov_optics=None, **changed):
    """Observations of an object that stands at one pixel position."""
    return tabulate_sightings(sighting(source, tracklet, flux, cov_optics, **changed))


def sighting(source="stars", tracklet="t", flux=np.nan, cov_optics=None, camera=CAMERA, **changed):
    u_sensor = unproject(CAMERA, *(np.full(N, p) for p in PLACE_PX))
    ra, dec = radec_from_unit(ATTITUDE.inv().apply(u_sensor))
    key = {
        "sensor_id": ["s"] * N, "frame_number": np.arange(N),
        "time": T0 + np.arange(N) * 1_000_000_000,
    }  # fmt: skip
    solutions = filled(SOLUTIONS, N, key | unstack("q{}", np.tile(ATTITUDE.as_quat(), (N, 1)),
                                                   "xyzw")
        | unstack_covariance("cov_att_{}_arcsec2", np.tile(COV_ATT, (N, 1, 1)))
        | unstack("{}_km", np.tile([7000.0, 0.0, 0.0], (N, 1)))
        | unstack("v{}_km_s", np.tile(V_KM_S, (N, 1)))
        | {"attitude_source": [source] * N, "used_position_sigma_km": np.full(N, 0.02)}
        | changed
    )  # fmt: skip
    detections = filled(DETECTIONS, N, key | {
        "centroid": np.zeros(N, np.int32), "ra_deg": np.degrees(ra), "dec_deg": np.degrees(dec),
        "sigma_arcsec": np.full(N, CENTROID), "kind": ["object"] * N,
        "tracklet_id": [tracklet] * N, "track_id": [tracklet] * N, "flux": np.full(N, flux),
        "x_px": np.full(N, PLACE_PX[0]), "y_px": np.full(N, PLACE_PX[1]),
    })  # fmt: skip
    cameras = cameras_of({"s": camera}, cov_optics)
    return sight_objects(solutions, detections, cameras, TrackletSettings(), HALF_WIDTH_S)


def passing(rate_deg_s, error_s):
    """Observations of an object that moves to the east; its times are off at random."""
    rng = np.random.default_rng(4)
    key = {
        "sensor_id": ["s"] * N, "frame_number": np.arange(N),
        "time": T0 + np.arange(N) * 100_000_000,
    }  # fmt: skip
    east = (np.arange(N) * 0.1 + rng.normal(0.0, error_s, N)) * rate_deg_s
    error = rng.normal(0.0, CENTROID / 3600.0, (2, N))
    solutions = filled(SOLUTIONS, N, key
        | unstack("q{}", np.tile([0.0, 0.0, 0.0, 1.0], (N, 1)), "xyzw")
        | unstack_covariance("cov_att_{}_arcsec2", np.zeros((N, 3, 3)))
        | unstack("{}_km", np.tile([7000.0, 0.0, 0.0], (N, 1)))
        | unstack("v{}_km_s", np.zeros((N, 3))) | {"attitude_source": ["stars"] * N}
    )  # fmt: skip
    detections = filled(DETECTIONS, N, key | {
        "centroid": np.zeros(N, np.int32), "ra_deg": 30.0 + east + error[0], "dec_deg": error[1],
        "sigma_arcsec": np.full(N, CENTROID), "kind": ["object"] * N, "tracklet_id": ["t"] * N,
    })  # fmt: skip
    cameras = cameras_of({"s": CAMERA}, None)
    return tabulate_sightings(
        sight_objects(solutions, detections, cameras, TrackletSettings(), HALF_WIDTH_S)
    )


def moved(seed, n=40_000):
    """East and north errors of the direction under random turns of the attitude [arcsec]."""
    rng = np.random.default_rng(seed)
    turns = rng.multivariate_normal(np.zeros(3), COV_ATT * ARCSEC**2, n)
    u_sensor = unproject(CAMERA, np.array([PLACE_PX[0]]), np.array([PLACE_PX[1]]))[0]
    u = ATTITUDE.inv().apply(Rotation.from_rotvec(turns).apply(u_sensor))
    ra, dec = radec_from_unit(u)
    true_ra, true_dec = radec_from_unit(ATTITUDE.inv().apply(u_sensor))
    off = np.stack([(ra - true_ra) * np.cos(true_dec), dec - true_dec], axis=1) / ARCSEC
    return off + rng.normal(size=off.shape) * CENTROID


def test_the_error_of_stars_attitudes_is_each_frames_own_in_east_and_north():
    rows, cov = sighted(), np.cov(moved(1).T)
    sigma = np.sqrt(np.diag(cov))
    assert array(rows, "sigma_ra_arcsec") == pytest.approx(np.full(N, sigma[0]), rel=0.02)
    assert array(rows, "sigma_dec_arcsec") == pytest.approx(np.full(N, sigma[1]), rel=0.02)
    correlation = cov[0, 1] / (sigma[0] * sigma[1])
    assert array(rows, "correlation") == pytest.approx(np.full(N, correlation), abs=0.02)
    assert array(rows, "bias_sigma_arcsec") == pytest.approx(np.zeros(N), abs=1e-6)


def test_the_error_of_a_prior_attitude_is_shared():
    rows = sighted("prior")
    assert array(rows, "sigma_ra_arcsec") == pytest.approx(np.full(N, CENTROID), rel=0.02)
    variance = np.trace(np.cov(moved(2).T)) / 2 - CENTROID**2
    assert array(rows, "bias_sigma_arcsec") == pytest.approx(np.full(N, variance**0.5), rel=0.02)


def test_fitted_optics_are_shared():
    principal_point = np.zeros((9, 9))
    principal_point[2, 2] = principal_point[3, 3] = 4.0  # [px^2]
    told = array(sighted("prior"), "bias_sigma_arcsec")
    fitted = array(sighted("prior", cov_optics=principal_point), "bias_sigma_arcsec")
    pixel_arcsec = 1 / 3000 / ARCSEC
    assert np.sqrt(fitted**2 - told**2) == pytest.approx(np.full(N, 2 * pixel_arcsec), rel=0.05)


def test_the_error_of_a_trail_is_along_the_motion():
    rows = passing(3.0, 2e-3)
    along, across = (array(rows, f"sigma_{axis}_arcsec") for axis in ("ra", "dec"))
    assert across == pytest.approx(CENTROID, rel=1e-3)
    assert np.mean(along) == pytest.approx(np.hypot(3.0 * 3600.0 * 2e-3, CENTROID), rel=0.25)
    assert array(passing(3.0, 0.0), "sigma_ra_arcsec") == pytest.approx(CENTROID, rel=1e-3)


def test_the_sensors_aberration_is_removed():
    rows = sighted()
    apparent = ATTITUDE.inv().apply(unproject(CAMERA, *(np.array([p]) for p in PLACE_PX)))[0]
    # To the first order: the source moves towards the velocity.
    still = apparent - (V_KM_S - apparent * (apparent @ V_KM_S)) / SPEED_OF_LIGHT_KM_S
    ra, dec = radec_from_unit(still / np.linalg.norm(still))
    assert array(rows, "ra_deg")[0] == pytest.approx(np.degrees(ra), abs=1e-7)
    assert array(rows, "dec_deg")[0] == pytest.approx(np.degrees(dec), abs=1e-7)


def test_magnitudes_are_by_the_frames_zero_point():
    per_frame = {
        "zero_mag": np.full(N, 25.0), "zero_variance_mag2": np.full(N, 0.03**2),
        "flux_floor_mag2": np.full(N, 0.04**2), "flux_photon_mag2": np.full(N, 1e4 * 0.05**2),
    }  # fmt: skip
    rows = sighted(flux=1e4, **per_frame)
    assert array(rows, "magnitude") == pytest.approx(np.full(N, 15.0))
    assert array(rows, "magnitude_sigma") == pytest.approx(np.full(N, np.sqrt(0.005)))
    assert sighted(**per_frame)["magnitude"].null_count == N  # no flux
    unknown = {"zero_mag": [None] * N, "zero_variance_mag2": [None] * N}
    assert sighted(flux=1e4, **unknown)["magnitude"].null_count == N


def test_frames_without_a_position_have_no_rows_and_without_a_velocity_nulls():
    unknown = np.arange(N) < 10
    rows = sighted(x_km=np.where(unknown, np.nan, 7000.0))
    assert array(rows, "frame_number").tolist() == list(range(10, N))
    nothing = {f"v{a}_km_s": [None] * N for a in "xyz"}
    rows = sighted(**nothing)
    assert rows["vx_km_s"].null_count == N
    assert np.isfinite(array(rows, "ra_deg")).all()


def test_without_tracklets_there_are_no_rows():
    assert sighted(tracklet=None).num_rows == 0


HOUR = Span(T0, T0 + 3_600_000_000_000)


def attributable(span=HOUR, **scene):
    """The attributables in a span."""
    ends = {"start_time": [T0], "end_time": [T0 + (N - 1) * 1_000_000_000]}
    runs = filled(TRACKLET_RUNS, 1, {"tracklet_id": ["t"], "sensor_id": ["s"], **ends})
    return tabulate_attributables(sighting(**scene), with_middle_in(runs, span))


def test_an_attributable_is_at_the_middle_and_has_the_observations_mean():
    found, rows = attributable(), sighted()
    assert array(found, "epoch").tolist() == [T0 + (N - 1) * 500_000_000]
    middle = np.mean(array(rows, "ra_deg")[N // 2 - 1 : N // 2 + 1])
    assert found["ra_deg"][0].as_py() == pytest.approx(middle, abs=1 / 3600)
    noise = array(rows, "sigma_dec_arcsec")[0]
    sigma = np.sqrt(found["cov_decdec"][0].as_py())
    assert noise / np.sqrt(N) < sigma < 2 * noise / np.sqrt(N)
    assert abs(found["ra_rate_arcsec_s"][0].as_py()) < 1.0
    shared = [table["bias_sigma_arcsec"][0].as_py() for table in (found, rows)]
    assert shared[0] == pytest.approx(shared[1])
    # The sensor at the middle, from the frame half a second before: it falls 1 m meanwhile.
    assert found["x_km"][0].as_py() == pytest.approx(7000.0 + 0.5 * V_KM_S[0], abs=2e-3)
    assert found["vz_km_s"][0].as_py() == pytest.approx(V_KM_S[2], abs=1e-2)


def test_an_attributable_belongs_to_the_span_of_its_middle():
    before, after = Span(T0 - 10, T0 + 5), Span(T0 + 5, T0 + 3_600_000_000_000)
    assert attributable(span=before).num_rows == 0
    assert attributable(span=after).num_rows == 1


def test_without_flux_or_position_these_are_null():
    found = attributable(**unstack("{}_km", np.full((N, 3), np.nan)))
    row = found.to_pylist()[0]
    assert row["magnitude"] is row["magnitude_scatter"] is row["x_km"] is None
    assert row["ra_deg"] is not None


def test_the_mean_magnitude_has_the_scatter_of_the_detections():
    rng = np.random.default_rng(4)
    flux = 1000.0 * 10 ** (0.4 * 0.3 * rng.normal(size=N))
    zero = {"zero_mag": np.full(N, 15.0), "zero_variance_mag2": np.full(N, 1e-4),
            "flux_floor_mag2": np.full(N, 1e-4), "flux_photon_mag2": np.zeros(N)}  # fmt: skip
    row = attributable(flux=flux, **zero).to_pylist()[0]
    magnitude = 15.0 - 2.5 * np.log10(flux)
    assert row["magnitude"] == pytest.approx(magnitude.mean(), abs=1e-6)
    assert row["magnitude_scatter"] == pytest.approx(magnitude.std(ddof=1))
    assert row["magnitude_sigma"] == pytest.approx(magnitude.std(ddof=1) / np.sqrt(N))
    assert attributable().to_pylist()[0]["magnitude"] is None


def test_a_sensor_on_the_ground_does_not_fall_between_its_frames():
    """Its frames are ten seconds apart: free fall in half of that would be 120 m."""
    frames = sighting(
        **unstack("{}_km", np.tile([6371.0, 0.0, 0.0], (N, 1))),
        **unstack("v{}_km_s", np.tile([0.0, 0.46, 0.0], (N, 1))),
    ).frames
    r_km, v_km_s = states_near_frames(frames, np.array([7]), np.array([-5.0]))
    np.testing.assert_allclose(r_km[0], [6371.0, 2.3, 0.0], atol=1e-9)
    np.testing.assert_allclose(v_km_s[0], [0.0, 0.46, 0.0], atol=1e-9)


@pytest.mark.parametrize("dt_s", [-60.0, -30.0, 0.5, 30.0])
def test_a_satellite_stays_on_its_orbit_far_from_its_frames(dt_s):
    """A parabola is 36 m off after half a minute: its frames may be a minute apart."""
    low = np.array([6900.0, 0.0, 0.0, 0.0, 5.4, 5.4])
    frames = sighting(
        **unstack("{}_km", np.tile(low[:3], (N, 1))),
        **unstack("v{}_km_s", np.tile(low[3:], (N, 1))),
    ).frames
    r_km, v_km_s = states_near_frames(frames, np.array([7]), np.array([dt_s]))
    true = trajectory(low, np.array([-dt_s]))[0][0]
    np.testing.assert_allclose(r_km[0], true[:3], atol=1e-3)
    np.testing.assert_allclose(v_km_s[0], true[3:], atol=1e-4)


def test_an_attributable_has_the_sensors_state_of_its_epoch_with_a_rolling_shutter_too():
    """The row of the object is exposed long before the frame, and the sensor moves on."""
    lines = CAMERA._replace(line_time_s=1e-3)
    way = unstack("{}_km", np.array([7000.0, 0.0, 0.0]) + np.arange(N)[:, None] * V_KM_S)
    rolling, whole = (
        attributable(camera=camera, **way).to_pylist()[0] for camera in (lines, CAMERA)
    )
    assert rolling["epoch"] == whole["epoch"]
    for name in ("x_km", "y_km", "z_km"):
        assert rolling[name] == pytest.approx(whole[name], abs=5e-3)

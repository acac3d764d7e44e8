"""Identify stars: frames of a simulated sensor, compared with its truth."""

import numpy as np
import pyarrow as pa
import pytest
from scenes.cameras import cameras_of
from scenes.identified import identified
from scenes.random_stars import CAMERA
from scipy.spatial.transform import Rotation

from epipole.io.catalogues.hipparcos import HIPPARCOS_EPOCH, read_hipparcos
from epipole.schemas.bridge import array, stack, stack_covariance, table
from epipole.schemas.settings import Settings
from epipole.schemas.work_tables import EXPOSURES, SENSOR_STATES_AT_FRAMES
from epipole.tasks.algorithms.geometry.camera import inside, project
from epipole.tasks.algorithms.geometry.directions import aberrate, canonical
from epipole.tasks.algorithms.star_catalogue import navigation_catalogue, star_directions
from epipole.tasks.algorithms.times import earth_barycentric, julian_year

T0_NS = 1_600_000_000_000_000_000
V_KM_S = np.array([3.0, -5.0, 4.5])
ARCSEC = np.pi / 648000
LIMIT = 6.3
DISTORTED = CAMERA._replace(k1=-0.05, k2=0.01, p1=2e-4, p2=-1e-4)


@pytest.fixture(scope="module")
def catalogue():
    return read_hipparcos()


@pytest.fixture(scope="module")
def sky(catalogue):
    """Return the stars' places 2 px merged, to LIMIT."""
    places = [np.radians(array(catalogue, n)) for n in ("ra_deg", "dec_deg")]
    names = ("parallax_mas", "pm_ra_mas_yr", "pm_dec_mas_yr")
    time = np.int64(T0_NS)
    years = float(julian_year(time)) - HIPPARCOS_EPOCH
    motions = [array(catalogue, n) for n in names]
    u = star_directions(*places, *motions, years, earth_barycentric(time)[0])
    nav = navigation_catalogue(
        array(catalogue, "star_id"), u, array(catalogue, "magnitude"), 2 * CAMERA.pixel_rad
    )
    n = np.searchsorted(nav.magnitude, LIMIT)
    return nav.star_id[:n], nav.u_icrs[:n], nav.magnitude[:n]


class Log:
    """Frames of a slowly turning sensor as tables, and their truth."""

    def __init__(self, sky, n, seed=0, sigma_px=0.2, stated=None, n_false=8, flux=True,
                 v_km_s=V_KM_S):  # fmt: skip
        rng = np.random.default_rng(seed)
        star_id, u, magnitude = sky
        time = T0_NS + np.arange(n) * 10**9
        _, v_earth = earth_barycentric(time)
        velocities = np.broadcast_to(v_km_s, (n, 3))
        first = Rotation.random(random_state=seed)
        self.q = np.empty((n, 4))
        self.ids, x_px, y_px, fluxes = [], [], [], []
        for k in range(n):
            R = Rotation.from_rotvec([2e-3 * k, 1e-3 * k, -1e-3 * k]) * first
            self.q[k] = canonical(R.as_quat())
            a = aberrate(u, v_earth[k] + velocities[k]) @ R.as_matrix().T
            x, y = project(DISTORTED, a)
            near = (a[:, 2] > 0.95) & inside(DISTORTED, x, y)
            false = rng.uniform(0, 1023, (2, n_false))
            x, y = np.concatenate([x[near], false[0]]), np.concatenate([y[near], false[1]])
            mag = np.concatenate([magnitude[near], rng.uniform(3, LIMIT, n_false)])
            order = rng.permutation(len(x))
            x_px.append((x + rng.normal(0, sigma_px, len(x)))[order])
            y_px.append((y + rng.normal(0, sigma_px, len(x)))[order])
            fluxes.append((10 ** (-0.4 * (mag - 20)))[order])
            self.ids.append(np.concatenate([star_id[near], np.full(n_false, -1)])[order])
        self.key = {"sensor_id": ["s"] * n, "frame_number": np.arange(n), "time": time}
        self.exposures = self.make_exposures(x_px, y_px, fluxes if flux else None, stated)
        self.places = self.make_centroid_cells()
        self.cameras = cameras_of({"s": DISTORTED})

    def make_exposures(self, x_px, y_px, flux=None, stated=None):
        n = len(x_px)
        return table(
            EXPOSURES,
            self.key
            | {
                "exposure_s": [0.1] * n,
                "x_px": [list(x) for x in x_px],
                "y_px": [list(y) for y in y_px],
                "flux": [None] * n if flux is None else [list(f) for f in flux],
                "sigma_px": [None] * n if stated is None else [[stated] * len(x) for x in x_px],
                "source": ["a.mcap"] * n,
                "offset": [None] * n,
            },
        )

    def make_centroid_cells(self, q=None, sigma_arcsec=None):
        n = len(self.q)
        prior = [None] * n if q is None else None
        return table(
            SENSOR_STATES_AT_FRAMES,
            self.key
            | {f"{a}_km": [7000.0] * n for a in "xyz"}
            | {f"v{a}_km_s": [V_KM_S[i]] * n for i, a in enumerate("xyz")}
            | {f"q{a}": prior or q[:, i] for i, a in enumerate("xyzw")}
            | {name: [0.05] * n for name in ("position_sigma_km", "used_position_sigma_km")}
            | {"attitude_sigma_arcsec": [sigma_arcsec] * n},
        )

    def errors(self, solutions):
        """Return the rotation vectors [arcsec] from reported to true attitude."""
        got = Rotation.from_quat(stack(solutions, "q{}", "xyzw"))
        return (Rotation.from_quat(self.q) * got.inv()).as_rotvec() / ARCSEC

    def run(self, catalogue, **changes):
        inputs = {"exposures": self.exposures, "places": self.places, "cameras": self.cameras}
        return identified(*(inputs | changes).values(), catalogue, Settings())


@pytest.fixture(scope="module")
def log(sky):
    return Log(sky, 40)


@pytest.fixture(scope="module")
def found(log, catalogue):
    return log.run(catalogue)


def test_every_frame_is_solved_and_no_star_is_wrong(log, found):
    assert found.solutions["attitude_source"].to_pylist() == ["stars"] * 40
    assert found.solutions["status"].null_count == 40
    frame, centroid = array(found.stars, "frame_number"), array(found.stars, "centroid")
    true = [log.ids[f][c] for f, c in zip(frame, centroid, strict=True)]
    np.testing.assert_array_equal(array(found.stars, "star_id"), true)
    assert len(true) > 0.98 * sum(np.sum(ids > 0) for ids in log.ids)


def test_centroids_that_are_sent_twice_count_once(log, catalogue, found):
    columns = log.exposures.select(["x_px", "y_px", "flux"]).to_pydict().values()
    twice = log.run(
        catalogue, exposures=log.make_exposures(*([2 * each for each in c] for c in columns))
    )
    assert twice.stars.equals(found.stars)
    assert twice.detections.equals(found.detections)
    assert found.rejects.num_rows == 0
    assert twice.rejects.select(["reason", "count"]).to_pylist() == [
        {"reason": "repeated_centroid", "count": sum(len(ids) for ids in log.ids)}
    ]


def test_attitude_errors_are_honest(log, found):
    errors, cov = (
        log.errors(found.solutions),
        stack_covariance(found.solutions, "cov_att_{}_arcsec2"),
    )
    nees = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(cov), errors)
    assert abs(np.mean(nees) - 3) < 4 * np.sqrt(6 / 40)
    sigma = stack(found.solutions, "sigma_{}_arcsec")
    np.testing.assert_allclose(sigma**2, np.diagonal(cov, axis1=1, axis2=2), rtol=1e-12)


def test_the_error_of_the_optics_is_in_the_sigma_of_every_attitude(log, found, catalogue):
    cov = np.zeros((9, 9))
    cov[2, 2] = 5.0**2  # a principal point off along columns: a turn about y
    fitted = log.run(catalogue, cameras=cameras_of({"s": DISTORTED}, cov))
    before, after = (stack(f.solutions, "sigma_{}_arcsec") for f in (found, fitted))
    expected = np.hypot(before[:, 1], 5.0 * DISTORTED.pixel_rad / ARCSEC)
    np.testing.assert_allclose(after[:, 1], expected, rtol=0.05)
    np.testing.assert_allclose(after[:, 0], before[:, 0], rtol=0.2)
    own = [stack_covariance(f.solutions, "cov_att_{}_arcsec2") for f in (found, fitted)]
    np.testing.assert_array_equal(own[0], own[1])


def test_an_unknown_centroid_error_is_estimated(found):
    at_centre = array(found.detections, "sigma_arcsec").max() * ARCSEC / DISTORTED.pixel_rad
    assert at_centre == pytest.approx(0.2, rel=0.05)
    assert np.mean(array(found.solutions, "residual_px")) == pytest.approx(0.2, rel=0.1)


@pytest.mark.parametrize("stated", [0.06, 0.2, 0.6])
def test_a_wrong_centroid_error_is_corrected_by_the_residuals(stated, sky, catalogue):
    log = Log(sky, 20, seed=1, stated=stated)
    found = log.run(catalogue)
    at_centre = array(found.detections, "sigma_arcsec").max() * ARCSEC / DISTORTED.pixel_rad
    assert at_centre == pytest.approx(0.2, rel=0.07)


def test_every_centroid_is_a_star_or_a_detection_once(log, found):
    pairs = [
        set(zip(array(t, "frame_number"), array(t, "centroid"), strict=True))
        for t in (found.stars, found.detections)
    ]
    assert not pairs[0] & pairs[1]
    assert len(pairs[0] | pairs[1]) == sum(len(ids) for ids in log.ids)
    assert array(found.solutions, "n_centroids").tolist() == [len(ids) for ids in log.ids]


def test_detections_stand_where_the_attitude_puts_their_pixels(log, found):
    d = found.detections
    ra, dec = np.radians(array(d, "ra_deg")), np.radians(array(d, "dec_deg"))
    u = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    q = stack(found.solutions, "q{}", "xyzw")[array(d, "frame_number")]
    x, y = project(DISTORTED, Rotation.from_quat(q).apply(u))
    np.testing.assert_allclose(x, array(d, "x_px"), atol=1e-6)
    np.testing.assert_allclose(y, array(d, "y_px"), atol=1e-6)


def test_running_again_gives_the_same_bits(log, found, catalogue):
    again = log.run(catalogue)
    assert all(a.equals(b) for a, b in zip(found, again, strict=True))


def test_the_order_of_rows_does_not_matter(log, found, catalogue):
    order = np.random.default_rng(0).permutation(40)
    again = log.run(catalogue, exposures=log.exposures.take(order), places=log.places.take(order))
    assert again.solutions.equals(found.solutions)


def without_velocities(places, frames=slice(None)):
    """Return the places, the velocities of these frames unknown."""
    for a in "xyz":
        i = places.column_names.index(f"v{a}_km_s")
        values = places[i].to_pylist()
        values[frames] = [None] * len(values[frames])
        places = places.set_column(i, places.schema.field(i), pa.array(values, pa.float64()))
    return places


def test_without_velocity_only_the_earths_aberration_is_left(log, catalogue, found):
    places = without_velocities(log.places)
    moved = log.errors(log.run(catalogue, places=places).solutions) - log.errors(found.solutions)
    # 7.4 km/s are 5.1"; what of it lies across the boresight.
    boresight = Rotation.from_quat(log.q).inv().apply([0, 0, 1])
    across = np.linalg.norm(np.cross(boresight, V_KM_S), axis=1) / 299792.458 / ARCSEC
    np.testing.assert_allclose(np.hypot(moved[:, 0], moved[:, 1]), across, atol=0.05)


def test_an_unknown_velocity_is_in_the_sigmas_across_the_boresight(sky, catalogue):
    v = np.random.default_rng(5).normal(size=(40, 3))
    v *= 7.6 / np.linalg.norm(v, axis=1, keepdims=True)
    log = Log(sky, 40, seed=2, sigma_px=0.02, v_km_s=v)
    solutions = log.run(catalogue, places=without_velocities(log.places)).solutions
    assert solutions["attitude_source"].to_pylist() == ["stars"] * 40
    off = log.errors(solutions) / stack(solutions, "sigma_{}_arcsec")
    # A component of a velocity is even from -7.6 to 7.6 km/s.
    assert 0.7 < np.mean(off[:, :2] ** 2) < 1.3
    assert np.abs(off[:, :2]).max() < 2.5
    assert 0.5 < np.mean(off[:, 2] ** 2) < 2.0


def test_sigmas_of_frames_with_a_velocity_do_not_have_its_error(log, catalogue, found):
    mixed = log.run(catalogue, places=without_velocities(log.places, slice(0, 10)))
    before, after = (stack(f.solutions, "sigma_{}_arcsec") for f in (found, mixed))
    np.testing.assert_allclose(before[10:], after[10:], rtol=1e-4)
    np.testing.assert_allclose(before[:, 2], after[:, 2], rtol=1e-4)
    added = np.sqrt(after[:10, :2] ** 2 - before[:10, :2] ** 2)
    np.testing.assert_allclose(added, 7.6 / np.sqrt(3) / 299792.458 / ARCSEC, rtol=1e-3)


def test_without_stars_the_prior_is_used_unchanged(sky, log, catalogue):
    rng = np.random.default_rng(3)
    x = [rng.uniform(0, 1023, 6) for _ in range(40)]
    exposures = log.make_exposures(x, x[::-1])
    places = log.make_centroid_cells(log.q, 25.0)
    found = log.run(catalogue, exposures=exposures, places=places)
    assert found.solutions["attitude_source"].to_pylist() == ["prior"] * 40
    assert set(found.solutions["status"].to_pylist()) == {"no_match", "not_searched"}
    np.testing.assert_allclose(stack(found.solutions, "q{}", "xyzw"), log.q, atol=1e-12)
    np.testing.assert_array_equal(array(found.solutions, "sigma_z_arcsec"), 25.0)
    assert found.detections.num_rows == 240
    assert found.rejects.num_rows == found.stars.num_rows == 0


def test_frames_without_attitude_are_data_and_their_centroids_have_no_direction(log, catalogue):
    empty: list[float] = []
    spot = [500.0 + 0.1 * k for k in range(9)]
    x = [empty, [5.0, 9.0], spot, *[[0.5 + k, 7.0, 300.0, 20.0] for k in range(37)]]
    found = log.run(catalogue, exposures=log.make_exposures(x, x))
    status = found.solutions["status"].to_pylist()
    assert status[:3] == ["no_centroids", "too_few_stars", "no_match"]
    assert set(found.solutions["attitude_source"].to_pylist()) == {"none"}
    assert found.solutions["qx"].null_count == 40
    assert found.detections.num_rows == sum(len(row) for row in x)
    for name in ("ra_deg", "dec_deg"):
        assert found.detections[name].null_count == found.detections.num_rows
    assert found.rejects.num_rows == 0


def test_a_sensor_without_calibration_keeps_its_frames_with_a_status(log, catalogue):
    found = log.run(catalogue, cameras=log.cameras.slice(0, 0))
    assert set(found.solutions["status"].to_pylist()) == {"no_calibration"}
    assert set(found.solutions["camera"].to_pylist()) == {-1}
    assert found.rejects["reason"].to_pylist() == ["no_calibration"]


def test_the_newest_calibration_is_used_or_the_first_for_earlier_frames(log, catalogue):
    late = [T0_NS + 5 * 10**9, T0_NS + 25 * 10**9, T0_NS]
    cameras = pa.concat_tables([log.cameras] * 3)
    names = pa.array(["s", "s", "other"])
    cameras = cameras.set_column(0, cameras.schema.field(0), names)
    cameras = cameras.set_column(1, cameras.schema.field(1), pa.array(late, cameras.schema[1].type))
    found = log.run(catalogue, cameras=cameras)
    assert found.solutions["camera"].to_pylist() == [0] * 25 + [1] * 15


@pytest.mark.long
def test_thousands_of_centroids_end_in_bounded_time(sky, log, catalogue):
    rng = np.random.default_rng(0)
    x, y = rng.uniform(0, 1023, (2, 2, 4000))
    two = log.exposures.slice(0, 2)
    exposures = table(
        EXPOSURES,
        {n: two[n] for n in two.column_names} | {"x_px": list(x), "y_px": list(y)}
        | {"flux": [None] * 2},
    )  # fmt: skip
    found = log.run(catalogue, exposures=exposures, places=log.places.slice(0, 2))
    assert set(found.solutions["attitude_source"].to_pylist()) == {"none"}


def test_of_too_many_detections_some_are_left_out_and_counted(log, catalogue):
    rng = np.random.default_rng(4)
    x = [rng.uniform(0, 1023, 60) for _ in range(40)]
    exposures = log.make_exposures(x, x[::-1])
    settings = Settings(tracklets={"max_detections": 1_000})
    found = identified(exposures, log.places, log.cameras, catalogue, settings)
    assert found.detections.num_rows == 1_000
    assert found.rejects["reason"].to_pylist() == ["too_many_detections"]
    assert found.rejects["count"].to_pylist() == [60 * 40 - 1_000]
    assert array(found.solutions, "n_centroids").sum() == 60 * 40


def test_no_frames_give_empty_tables(log, catalogue):
    found = log.run(catalogue, exposures=log.exposures.slice(0, 0), places=log.places.slice(0, 0))
    assert [t.num_rows for t in found] == [0, 0, 0, 0]

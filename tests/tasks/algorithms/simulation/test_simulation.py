"""The simulated sky against skyfield, and against logs made by another simulator."""

import json
import warnings
from functools import partial
from pathlib import Path

import erfa
import numpy as np
import polars as pl
import pytest
from astropy.time import Time
from scenes.simulated import scene_of
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from skyfield.api import Star, load
from skyfield.elementslib import OsculatingElements
from skyfield.keplerlib import propagate
from skyfield.relativity import add_aberration
from skyfield.units import Distance, Velocity
from skyfield.vectorlib import VectorFunction

from epipole.io.catalogues.star_catalogue import write_star_catalogue
from epipole.io.logs.reader import read_log
from epipole.io.simulation.scenes import read_scene
from epipole.io.simulation.sky import read_hipparcos_stars, read_stars
from epipole.schemas.bridge import flatten, table
from epipole.schemas.errors import SceneError
from epipole.schemas.scene import validate_scene
from epipole.schemas.star_lists import STAR_CATALOGUE, CatalogueLabel, labelled
from epipole.tasks.algorithms.simulation.constants import GM_KM3_S2
from epipole.tasks.algorithms.simulation.element_sets import (
    barycentric_julian_date,
    earth_at,
    julian_years_since,
)
from epipole.tasks.algorithms.simulation.optics import (
    TrueOptics,
    boost,
    image_position,
    received_from,
)
from epipole.tasks.algorithms.simulation.paths import elements_from_state, state_at
from epipole.tasks.algorithms.simulation.sources import star_directions, star_field
from epipole.tasks.algorithms.star_catalogue import propagate_positions
from epipole.tasks.simulate.simulate_scene import expose_blocks, simulate_scene

MAS = np.pi / 648e6
AU_KM, DAY_S = 149597870.7, 86400.0
T0_NS = 1_554_091_200_000_000_000  # 2019-04-01T04:00Z
LOGS = Path(__file__).parents[5] / "shared" / "data" / "logs"
TIMES = load.timescale(builtin=True)

LOW = np.array([6978.0, 0.001, 1.71, 0.3, 0.2, 0.9])
HIGH = np.array([42164.0, 0.02, 0.1, 2.7, 0.4, 5.9])


def moment(t_s):
    """Return skyfield's time of seconds after T0."""
    return TIMES.utc(2019, 4, 1, 4, 0, t_s)


def time_ns(t_s):
    return T0_NS + np.rint(np.atleast_1d(t_s) * 1e9).astype(np.int64)


class Orbiting(VectorFunction):
    """A body on an orbit about the Earth, for skyfield: barycentric position and velocity."""

    def __init__(self, elements, target):
        self.center, self.target, self.elements = 0, target, elements

    def _at(self, t):
        start = moment(0.0)
        days = (t.whole - start.whole) + (t.tdb_fraction - start.tdb_fraction)
        earth = erfa.epv00(t.whole, t.tdb_fraction)[1]
        r_km, v_km_s = state_at(self.elements, days * DAY_S)
        p, v = earth["p"] + r_km / AU_KM, earth["v"] + v_km_s * (DAY_S / AU_KM)
        return p, v, None, None


def apparent(observer, body):
    """Return skyfield's unit vectors, (n, 3), as the observer in its motion sees a body."""
    seen = observer.observe(body)
    u = np.array(seen.position.au).reshape(3, -1)
    light_time = np.atleast_1d(seen.light_time)
    u = u.copy()
    add_aberration(u, observer.velocity.au_per_d[:, None], light_time)
    return (u / np.linalg.norm(u, axis=0)).T


def angle(u, v):
    """Return angles between unit vectors, exact where they are small."""
    return 2 * np.arcsin(np.linalg.norm(u - v, axis=-1) / 2)


def star_of(stars, at):
    return Star(
        ra_hours=np.degrees(stars.ra[at]) / 15,
        dec_degrees=np.degrees(stars.dec[at]),
        ra_mas_per_year=stars.pm_ra_mas_yr[at],
        dec_mas_per_year=stars.pm_dec_mas_yr[at],
        parallax_mas=np.maximum(stars.parallax_mas[at], 0),
        epoch=2448349.0625,
    )


def test_the_earth_between_nodes_is_where_the_series_puts_it():
    t = np.random.default_rng(0).integers(T0_NS, T0_NS + 86400 * 10**9, 200)
    r_km, v_km_s = earth_at(t)
    at = moment((t - T0_NS) / 1e9)
    earth = erfa.epv00(at.whole, at.tdb_fraction)[1]
    assert np.abs(r_km - earth["p"] * AU_KM).max() < 1e-3  # 1 m, and light moves on 0.3 km a us
    assert np.abs(v_km_s - earth["v"] * AU_KM / DAY_S).max() < 1e-7


@pytest.mark.parametrize(
    "instant",
    ["2019-04-01T04:00:00", "2016-12-31T18:00:00", "2017-01-01T00:00:00", "2049-07-01T12:34:56"],
)
@pytest.mark.filterwarnings("error")
def test_barycentric_time_is_astropys_on_leap_second_days_and_in_far_years(instant):
    ns = np.datetime64(instant, "ns").astype(np.int64)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # astropy's own doubt of 2049
        expected = Time(instant, scale="utc").tdb
    jd1, jd2 = barycentric_julian_date(ns)
    off_s = ((jd1 - expected.jd1) + (jd2 - expected.jd2)) * DAY_S
    assert abs(off_s) < 50e-6  # the largest term left out of TDB - TT has 22 us


@pytest.mark.parametrize("elements", [LOW, HIGH, [26600.0, 0.74, 1.1, 4.0, 4.7, 0.1]])
def test_orbits_are_those_of_skyfield(elements):
    elements = np.array(elements)
    r0, v0 = state_at(elements, np.float64(0))
    t_s = np.linspace(-7000, 90000, 50)
    r, v = state_at(elements, t_s)
    expected_r, expected_v = propagate(r0, v0, 0.0, t_s, GM_KM3_S2)
    np.testing.assert_allclose(r, np.array(expected_r).T, rtol=0, atol=1e-4)
    np.testing.assert_allclose(v, np.array(expected_v).T, rtol=0, atol=1e-7)
    osculating = OsculatingElements(Distance(km=r0), Velocity(km_per_s=v0), moment(0.0), GM_KM3_S2)
    names = ("inclination", "longitude_of_ascending_node", "argument_of_periapsis", "mean_anomaly")
    angles = [getattr(osculating, name).radians for name in names]
    found = [osculating.semi_major_axis.km, osculating.eccentricity, *angles]
    np.testing.assert_allclose(found, elements, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(
        np.remainder(elements_from_state(r0, v0), [np.inf, np.inf, *[2 * np.pi] * 4]),
        elements, rtol=1e-9, atol=1e-9,
    )  # fmt: skip


def test_objects_are_seen_where_skyfield_sees_them():
    rng = np.random.default_rng(1)
    for t_s in rng.uniform(0, 80000, 20):
        low, high = LOW.copy(), HIGH.copy()
        low[5], high[5] = rng.uniform(0, 6, 2)
        observer = Orbiting(low, -9001).at(moment(t_s))
        expected = apparent(observer, Orbiting(high, -9002))
        r_km, v_km_s = state_at(low, np.array([t_s]))
        _, earth_km_s = earth_at(time_ns(t_s))
        d_km, _ = received_from(partial(state_at, high[None, :]), np.array([t_s]), r_km, earth_km_s)
        u = boost(d_km / np.linalg.norm(d_km), earth_km_s + v_km_s)
        assert angle(u, expected)[0] < 0.1 * MAS


def field_of(stars, **changes):
    return star_field(**(stars._asdict() | changes), radius_rad=0.05)


def test_a_scene_with_a_catalogue_file_shows_its_stars(tmp_path):
    # Hipparcos' stars of the truth below at another epoch and under other numbers.
    hipparcos = read_stars("hipparcos", 6.5)
    ra, dec, pm_ra, pm_dec = propagate_positions(
        hipparcos.ra, hipparcos.dec, hipparcos.pm_ra_mas_yr, hipparcos.pm_dec_mas_yr, 20.0
    )
    none = np.zeros(len(ra))
    columns = {
        "star_id": hipparcos.star_id + 10**6,
        "ra_deg": np.degrees(ra),
        "dec_deg": np.degrees(dec),
        "pm_ra_mas_yr": pm_ra,
        "pm_dec_mas_yr": pm_dec,
        "parallax_mas": hipparcos.parallax_mas,
        "sigma_mas": none,
        "pm_sigma_mas_yr": none,
        "magnitude": hipparcos.magnitude,
        "variable": none > 0,
    }
    label = CatalogueLabel("later", 2011.25, "a test")
    path = tmp_path / "later.parquet"
    write_star_catalogue(path, labelled(table(STAR_CATALOGUE, columns), label))
    sensor = {
        "id": "a",
        "orbit": {"a_km": 7000.0},
        "camera": {"fov_deg": 15.0},
        "pointing": {"mode": "fixed", "ra_deg": 85.0, "dec_deg": 0.0},
        "magnitude_limit": 6.0,
    }
    scene = {"name": "s", "duration_s": 1.0, "sensors": [sensor]}
    seen = []
    for catalogue in ("hipparcos", str(path)):
        simulation = simulate_scene(validate_scene(scene | {"catalogue": catalogue}, "s"))
        ((exposures,),) = expose_blocks(simulation)
        order = np.argsort(exposures.source)
        place = np.stack([exposures.x_px, exposures.y_px], axis=1)[order]
        seen.append((exposures.source[order], place))
    assert len(seen[0][0]) > 20
    np.testing.assert_array_equal(seen[0][0] + 10**6, seen[1][0])
    # Noise is drawn by the order of stars, which is the same: 0.001 px are 0.05 arcsec.
    np.testing.assert_allclose(seen[0][1], seen[1][1], atol=1e-3)


@pytest.mark.parametrize("content", [None, b"", b"text"])
def test_a_scene_names_a_catalogue_that_cannot_be_read(content, tmp_path):
    path = tmp_path / "stars.parquet"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(SceneError, match=r"stars\.parquet: not a star catalogue"):
        read_stars(str(path), 9.0)


def test_stars_are_seen_where_skyfield_sees_them():
    stars = read_hipparcos_stars(4.0)
    field = field_of(stars)
    row = np.argsort(stars.star_id)[np.searchsorted(np.sort(stars.star_id), field.star_id)]
    for t_s in (0.0, 40000.0, 120 * 86400.0):
        observer = Orbiting(LOW, -9001).at(moment(t_s))
        expected = apparent(observer, star_of(stars, row))
        r_km, v_km_s = state_at(LOW, np.array([t_s]))
        earth_km, earth_km_s = earth_at(time_ns(t_s))
        n = len(row)
        years = np.repeat(julian_years_since(1991.25, time_ns(t_s)), n)
        u = star_directions(field, np.arange(n), years, np.repeat(earth_km + r_km, n, axis=0))
        u = boost(u, np.repeat(earth_km_s + v_km_s, n, axis=0))
        assert angle(u, expected).max() < 0.05 * MAS


def close_to_others(stars, radius_rad):
    """Return the ids of stars that may share a spot with another."""
    place = np.stack(
        [np.cos(stars.dec) * np.cos(stars.ra), np.cos(stars.dec) * np.sin(stars.ra),
         np.sin(stars.dec)], axis=1,
    )  # fmt: skip
    pairs = cKDTree(place).query_pairs(radius_rad, output_type="ndarray")
    return set(stars.star_id[pairs].ravel().tolist())


def test_a_whole_image_is_what_skyfield_and_a_pinhole_make_of_it():
    scene = read_scene("four_sensor_geo").model_dump(exclude_unset=True)
    for sensor in scene["sensors"]:
        sensor["detection"] |= {"sigma_px": 1e-9, "star_drop": 0.0, "target_drop": 0.0}
    simulation = simulate_scene(validate_scene(scene | {"duration_s": 3.0}, "test"))
    stars = read_hipparcos_stars(10.0)
    row = {int(star): i for i, star in enumerate(stars.star_id)}
    blended = close_to_others(stars, np.radians(3 * 2 / 512))
    pinhole = [256 / np.tan(np.radians(1.0)), 252.44, 235.33]
    seen_stars = seen_targets = 0
    for sensor, seen in zip(simulation.sensors, next(expose_blocks(simulation)), strict=True):
        for i in range(len(seen.time_ns)):
            part = slice(seen.offsets[i], seen.offsets[i + 1])
            kind, source = seen.kind[part], seen.source[part].tolist()
            observer = Orbiting(sensor.path.elements[0], -9001).at(
                moment((seen.time_ns[i] - T0_NS) / 1e9)
            )
            at = [k for k in range(len(kind)) if kind[k] == 0 and source[k] not in blended]
            u = [apparent(observer, star_of(stars, np.array([row[source[k]] for k in at])))]
            targets = [k for k in range(len(kind)) if kind[k] == 1]
            orbits = [
                Orbiting(simulation.objects.paths.elements[source[k]], -9002) for k in targets
            ]
            u = np.concatenate(u + [apparent(observer, orbit) for orbit in orbits])
            q = seen.attitude[i].as_quat()
            x, y, z = Rotation.from_quat(q).apply(u).T
            f, cx, cy = pinhole
            found = np.stack([seen.x_px[part], seen.y_px[part]])[:, at + targets]
            off = found - [f * x / z + cx, f * y / z + cy]
            assert np.abs(off).max() < 0.1 * MAS * f
            seen_stars, seen_targets = seen_stars + len(at), seen_targets + len(targets)
    assert seen_targets > 9 * 4 * 2
    assert seen_stars > 40


@pytest.mark.parametrize(
    "name", ["four_sensors_2deg", "six_sensors_8deg_no_prior", "lost_in_space_20deg"]
)
def test_it_reproduces_the_logs_of_another_simulator_to_their_noise(name):
    log = LOGS / f"{name}.mcap"
    if not log.exists():
        pytest.skip("no ../shared")
    scenario = json.loads(Path(f"{log}.truth/scenario.json").read_text())
    sigma_px = scenario["sensors"][0]["sigma_px"]
    spots = spots_of(log)
    optics = optics_of(log)
    r_km, v_km_s = (spots[[f"{p}{a}" for a in "xyz"]].to_numpy() for p in ("", "v"))
    q = Rotation.from_quat(spots[["qx", "qy", "qz", "qw"]].to_numpy())
    t_ns = spots["t_ns"].to_numpy()
    earth_km, earth_km_s = earth_at(t_ns)
    is_star = spots["kind"].to_numpy() == 0
    source = spots["source"].to_numpy()

    stars = read_hipparcos_stars(scenario["sensors"][0]["mag_limit"] + 0.1)
    field = field_of(stars, parallax_mas=np.zeros(len(stars.ra)))
    order = np.argsort(field.star_id)
    star = order[np.searchsorted(field.star_id[order], source[is_star])]
    d = np.empty((len(spots), 3))
    years = julian_years_since(1991.25, t_ns[is_star])
    d[is_star] = star_directions(field, star, years, (earth_km + r_km)[is_star])
    if scenario["targets"]:
        orbits = np.array([target["elements"] for target in scenario["targets"]])
        t_s = (t_ns - scenario["t0_ns"]) / 1e9
        of = orbits[source[~is_star]]
        d[~is_star], _ = received_from(
            partial(state_at, of), t_s[~is_star], r_km[~is_star], earth_km_s[~is_star]
        )
    u = boost(d / np.linalg.norm(d, axis=1, keepdims=True), earth_km_s + v_km_s)
    x, y = image_position(optics, q.apply(u))
    off = np.stack([spots["column"].to_numpy() - x, spots["row"].to_numpy() - y], axis=1) / sigma_px
    blended = np.isin(source, list(close_to_others(stars, 4 / optics.fx_px))) & is_star
    for kind in (is_star & ~blended, ~is_star):
        if kind.any():
            n = 2 * kind.sum()
            assert abs(off[kind].mean()) < 4 / np.sqrt(n)
            assert abs(off[kind].std() - 1) < 4 / np.sqrt(2 * n)
            assert np.abs(off[kind]).max() < 5.5


@pytest.mark.parametrize("line_time_s", [1e-4, -5e-5])
def test_each_spot_of_a_rolling_shutter_is_where_it_is_when_its_row_is_exposed(line_time_s):
    quiet = {"sigma_px": 1e-9, "false_points": 0.0}
    pointing = {"mode": "spin", "ra_deg": 61.0, "dec_deg": 2.0, "axis": [0.3, 0.8, -0.2]}
    camera = {"fov_deg": 12.0, "line_time_s": line_time_s}
    near = {"a_km": 7400.0, "true_anomaly_deg": 2.0}
    scene = scene_of(
        {"pointing": pointing | {"rate_deg_s": 1.5}, "camera": camera, "detection": quiet,
         "orbit": {"a_km": 7000.0, "true_anomaly_deg": -4.0}, "rate_hz": 5.0},
        duration_s=4.0,
        targets=[{"orbit": near, "count": 20, "spread_km": 100.0, "magnitude": 5.0}],
    )  # fmt: skip
    simulation = simulate_scene(scene)
    (seen,) = next(expose_blocks(simulation))
    frame = np.repeat(np.arange(len(seen.time_ns)), np.diff(seen.offsets))
    t_s = (seen.time_ns - simulation.t0_ns) / 1e9
    row_s = t_s[frame] + (seen.y_px - 511.5) * line_time_s
    # The sensor turns evenly: between two frames, and beyond the last, along one arc.
    turn = (seen.attitude[-1] * seen.attitude[0].inv()).as_rotvec() / (t_s[-1] - t_s[0])
    q = Rotation.from_rotvec((row_s - t_s[0])[:, None] * turn) * seen.attitude[0]
    earth_km, earth_km_s = earth_at(simulation.t0_ns + np.rint(row_s * 1e9).astype(np.int64))
    r_km, v_km_s = state_at(simulation.sensors[0].path.elements, row_s)
    is_star = seen.kind == 0
    stars = read_hipparcos_stars(8.0)
    field = field_of(stars)
    d = np.empty((len(frame), 3))
    order = np.argsort(field.star_id)
    star = order[np.searchsorted(field.star_id[order], seen.source[is_star])]
    years = julian_years_since(1991.25, seen.time_ns[frame[is_star]])
    d[is_star] = star_directions(field, star, years, (earth_km + r_km)[is_star])
    paths = simulation.objects.paths.elements[seen.source[~is_star]]
    d[~is_star], _ = received_from(
        partial(state_at, paths), row_s[~is_star], r_km[~is_star], earth_km_s[~is_star]
    )
    u = q.apply(boost(d / np.linalg.norm(d, axis=1, keepdims=True), earth_km_s + v_km_s))
    x, y = image_position(simulation.sensors[0].optics, u)
    off_px = np.hypot(seen.x_px - x, seen.y_px - y)
    alone = ~np.isin(seen.source, list(close_to_others(stars, 1e-3)))
    assert (is_star & alone).sum() > 100
    assert (~is_star).sum() > 100
    assert off_px[alone | ~is_star].max() < 2e-3
    assert np.ptp(row_s - t_s[frame]) > 1000 * abs(line_time_s) * 0.9


def spots_of(log):
    """Return the stars and objects of a log, with their places and their frames' truth."""
    exposures = read_log(log).exposures
    x, offsets = flatten(exposures, "x_px")
    y, _ = flatten(exposures, "y_px")
    n = np.diff(offsets)
    measured = pl.DataFrame(
        {
            "sensor_id": np.repeat(np.array(exposures["sensor_id"].to_pylist()), n),
            "frame_number": np.repeat(exposures["frame_number"].to_numpy(), n),
            "centroid": np.arange(len(x)) - np.repeat(offsets[:-1], n),
            "column": x,
            "row": y,
        }
    )
    frames, points = (
        pl.read_parquet(f"{log}.truth/{name}.parquet").with_columns(
            pl.col("frame_number").cast(pl.Int64)
        )
        for name in ("frames", "points")
    )
    key = ["sensor_id", "frame_number"]
    points = points.filter(pl.col("kind") < 2).with_columns(pl.col("centroid").cast(pl.Int64))
    return points.join(frames, on=key).join(measured, on=[*key, "centroid"])


def optics_of(log):
    """Return the one calibration of a log."""
    cameras = read_log(log).cameras.select(TrueOptics._fields).to_pylist()
    assert all(camera == cameras[0] for camera in cameras)
    return TrueOptics(**cameras[0])

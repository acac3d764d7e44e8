"""A constellation: satellites, trackers fixed to the body, blends and trails."""

import itertools

import numpy as np
import pytest
from scenes.simulated import SENSOR, scene_of
from sgp4.api import WGS72, Satrec
from skyfield.api import EarthSatellite, load
from skyfield.positionlib import ICRF

from epipole.io.simulation.scenes import read_scene
from epipole.schemas.errors import SceneError
from epipole.schemas.scene import validate_scene
from epipole.tasks.algorithms.simulation.element_sets import directions_to_sun
from epipole.tasks.algorithms.simulation.exposures import (
    FALSE,
    SEGMENT_S,
    STAR,
    TARGET,
    Exposing,
    blended,
    true_spots,
)
from epipole.tasks.algorithms.simulation.sensor import body_fixed, frame_times
from epipole.tasks.simulate import simulate_scene as stage
from epipole.tasks.simulate.draw_objects import constellation


def scene_with(near=False, satellites=12, objects=400, **changes):
    values = read_scene("constellation").model_dump(exclude_unset=True)
    for group in [*values["sensors"], values["targets"][1]]:
        group["count"] = satellites
        group["orbit"]["near"] = near
    values["targets"][0]["count"] = objects
    return validate_scene(values | changes, "constellation")


def test_satellites_are_those_of_the_shells_and_the_same_for_both_trackers():
    simulation = stage.simulate_scene(scene_with())
    assert simulation.satellites == [f"s{k:03d}" for k in range(1, 13)] * 2
    assert [s.sensor_id for s in simulation.sensors][::12] == ["s001a", "s001b"]
    t_s = np.array([0.0, 100.0])
    for a, b, object_row in zip(range(12), range(12, 24), range(400, 412), strict=True):
        r_km, v_km_s = simulation.sensors[a].path.at(t_s)
        np.testing.assert_array_equal(r_km, simulation.sensors[b].path.at(t_s)[0])
        np.testing.assert_array_equal(r_km, simulation.objects.paths.at(t_s, object_row)[0])
        normal = np.cross(r_km[0], v_km_s[0])
        tilt = np.degrees(np.arccos(normal[2] / np.linalg.norm(normal)))
        shells = np.array([(550, 53), (540, 53.2), (570, 70), (560, 97.6), (1200, 87.9)])
        off = np.abs(shells - (np.linalg.norm(r_km[0]) - 6378.1, tilt))
        assert ((off[:, 0] < 60.0) & (off[:, 1] < 0.5)).any()
    other = stage.simulate_scene(scene_with(seed=2))
    assert np.linalg.norm(other.sensors[0].path.at(0.0)[0] - r_km[0]) > 100.0


def test_satellites_are_near_each_other_only_where_that_is_wanted():
    far_km = {}
    for near in (False, True):
        scene = scene_with(near=near, satellites=16)
        t0_ns = round(scene.start.timestamp()) * 10**9
        found = constellation(scene, scene.sensors[0].orbit, 16, t0_ns)
        r_km, _ = found.paths.at(np.full(16, scene.duration_s / 2), np.arange(16))
        far_km[near] = max(np.linalg.norm(a - b) for a, b in itertools.combinations(r_km, 2))
    assert far_km[True] < 2500.0
    assert far_km[False] > 12_000.0
    with pytest.raises(SceneError, match="4825 satellites are wanted of 4824 in the shells"):
        constellation(scene, scene.sensors[0].orbit, 4825, t0_ns)


def test_the_satellites_move_as_skyfield_says():
    simulation = stage.simulate_scene(scene_with())
    ts = load.timescale(builtin=True)
    utc = np.datetime64(simulation.t0_ns, "ns").astype("datetime64[s]").item()
    for k in range(3):
        satrec = Satrec()
        satrec.sgp4init(WGS72, "i", 0, *simulation.sensor_sets[k].elements)
        satellite = EarthSatellite.from_satrec(satrec, ts)
        seconds = np.array([0.0, 33.0, 150.0])
        at = ts.utc(utc.year, utc.month, utc.day, utc.hour, utc.minute, utc.second + seconds)
        position: ICRF = satellite.at(at)
        r_km, _ = simulation.sensors[k].path.at(seconds)
        np.testing.assert_allclose(r_km, position.position.km.T, atol=0.01)


def test_trackers_are_fixed_to_the_body_away_from_the_earth_the_sun_and_each_other():
    simulation = stage.simulate_scene(scene_with(satellites=40))
    (sun,) = directions_to_sun(np.array([simulation.t0_ns]))
    boresights = []
    for sensor in simulation.sensors:
        r, v = sensor.path.at(np.array([0.0, 140.0]))
        R = body_fixed(r, v, sensor.azimuth, sensor.elevation, sensor.roll).as_matrix()
        up = r / np.linalg.norm(r, axis=1, keepdims=True)
        across = np.cross(r, v)
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        body = np.stack([np.cross(across, up), across, up], axis=1)
        in_body = np.einsum("nij,nj->ni", body, R[:, 2])
        np.testing.assert_allclose(in_body[0], in_body[1], atol=1e-12)
        assert 10.9 < np.degrees(np.arcsin(in_body[0, 2])) < 45.1
        boresights.append(R[0, 2])
        # To the Sun, in the horizontal: 118 degrees or more away.
        level_sun = sun - up[0] * (sun @ up[0])
        level = R[0, 2] - up[0] * (R[0, 2] @ up[0])
        cosine = level @ level_sun / np.linalg.norm(level) / np.linalg.norm(level_sun)
        assert np.degrees(np.arccos(cosine)) > 117.9
    a, b = np.array(boresights).reshape(2, 40, 3)
    apart = np.degrees(np.arccos(np.einsum("ij,ij->i", a, b)))
    assert apart.min() > 30.0
    assert np.ptp(apart) > 20.0  # no two satellites are alike


def test_satellites_of_one_name_are_one():
    values = scene_with().model_dump(exclude_unset=True)
    values["sensors"][1]["count"] = 11
    with pytest.raises(SceneError, match="two satellites would be called s0"):
        stage.simulate_scene(validate_scene(values, "constellation"))


def test_half_of_the_satellites_send_attitudes_from_both_trackers():
    simulation = stage.simulate_scene(scene_with(satellites=60))
    a, b = np.array([s.prior_noise is not None for s in simulation.sensors]).reshape(2, 60)
    np.testing.assert_array_equal(a, b)
    assert 15 < a.sum() < 45


def pairs_about_field(exposing, segment_s, monkeypatch):
    monkeypatch.setattr("epipole.tasks.algorithms.simulation.exposures.SEGMENT_S", segment_s)
    sensor = exposing.sensor
    _, time_ns = frame_times(sensor)
    t_s = (time_ns - sensor.t0_ns) / 1e9
    r_km, v_km_s = sensor.path.at(t_s)
    R = exposing.attitudes.at(time_ns, r_km, v_km_s).as_matrix()
    if segment_s is None:  # all objects in all frames
        everything = np.arange(len(exposing.objects))
        return exposing._in_cone(t_s, r_km, R, np.arange(len(t_s)), everything)
    parts = exposing._pairs_about_field(t_s, r_km, R)
    return [np.concatenate(column) for column in zip(*parts, strict=True)]


@pytest.mark.parametrize("mode", ["body", "spin"])
def test_no_object_about_the_field_is_missed(mode, monkeypatch):
    """Candidates are chosen for some frames at once, and none that is there is left out."""
    if mode == "body":
        scene = scene_with(satellites=4, objects=4000, duration_s=30.0)
    else:
        low = {"orbit": {"random": "leo"}, "count": 4000, "magnitude": 5.0}
        spin = {"mode": "spin", "ra_deg": 10.0, "dec_deg": 5.0, "rate_deg_s": 2.0}
        sensor = {"pointing": spin, "rate_hz": 4.0, "camera": {"fov_deg": 50.0}}
        scene = scene_of(sensor, targets=[low], duration_s=30.0)
    simulation = stage.simulate_scene(scene)
    sky, n = stage.SceneSky(simulation), 0
    for sensor in simulation.sensors:
        exposing = Exposing(sensor, sky.field(sensor), simulation.objects)
        all_pairs = pairs_about_field(exposing, None, monkeypatch)
        for segment_s in (SEGMENT_S, 0.0):
            found = pairs_about_field(exposing, segment_s, monkeypatch)
            np.testing.assert_array_equal(found[0], all_pairs[0])
            np.testing.assert_array_equal(found[1], all_pairs[1])
        n += len(all_pairs[0])
    assert n > 100


def spots(kind, frame, x, y, magnitude, source):
    columns = [np.array(c, float) for c in (x, y, magnitude)]
    return true_spots(np.array(frame), *columns, kind, np.array(source))


def joined(*parts):
    return type(parts[0])(*[
        np.concatenate([getattr(part, name) for part in parts]) for name in vars(parts[0])
    ])  # fmt: skip


def test_near_spots_of_a_frame_are_one_at_the_middle_of_their_light():
    third = 2.5 * np.log10(3)
    stars = spots(STAR, [0, 1, 0], [10, 10, 90], [10, 10, 90], [4.0, 4.0, 5.0], [7, 7, 8])
    targets = spots(TARGET, [0, 0, 0, 1], [11.9, 50, 51, 30], [10, 50, 50, 30],
                    [4.0 + third, 5.0 + third, 5.0, 6.0], [100, 101, 102, 103])  # fmt: skip
    made = blended(joined(stars, targets), 2.0)
    names = zip(made.frame.tolist(), made.kind.tolist(), made.source.tolist(), strict=True)
    rows = {name: i for i, name in enumerate(names)}
    assert sorted(rows) == [(0, STAR, 7), (0, STAR, 8), (0, TARGET, 102), (1, STAR, 7),
                            (1, TARGET, 103)]  # fmt: skip
    assert made.frame.tolist() == [0, 0, 0, 1, 1]
    star, pair = rows[0, STAR, 7], rows[0, TARGET, 102]
    assert made.also[[star, pair]].tolist() == [100, 101]
    assert (made.also >= 0).sum() == 2
    assert made.x_px[star] == pytest.approx(0.75 * 10 + 0.25 * 11.9)
    assert made.x_px[pair] == pytest.approx(0.75 * 51 + 0.25 * 50)
    assert made.magnitude[star] == pytest.approx(4.0 - 2.5 * np.log10(4 / 3))
    # Near ones of another frame, and those just apart, stay as they are.
    assert made.x_px[rows[1, STAR, 7]] == 10.0
    apart = spots(TARGET, [0, 0], [0, 2.01], [0, 0], [5, 5], [1, 2])
    assert len(blended(apart, 2.0).frame) == 2
    assert len(blended(spots(STAR, [], [], [], [], []), 2.0).frame) == 0


def test_two_objects_that_are_too_faint_alone_are_seen_as_one():
    at = {"a_km": 7400.0, "mean_anomaly_deg": 5.0}
    faint = [{"orbit": at, "magnitude": 6.4}, {"orbit": at, "magnitude": 6.5}]
    sensor = {"pointing": {"target": 0}, "magnitude_limit": 6.0, "detection": {"sigma_px": 0.1}}
    for blend_px, number in ((0.0, 0), (2.0, 20)):
        detection = sensor["detection"] | {"blend_px": blend_px}
        scene = scene_of(sensor | {"detection": detection}, targets=faint)
        (seen,) = next(stage.expose_blocks(stage.simulate_scene(scene)))
        assert (seen.kind == TARGET).sum() == number
        if number:
            assert set(seen.source[seen.kind == TARGET]) == {0}
            assert set(seen.also[seen.kind == TARGET]) == {1}
            assert set(seen.also[seen.kind != TARGET]) <= {-1, 0, 1}


def test_a_trail_widens_the_error_along_the_motion_only():
    target = {"orbit": {"a_km": 7100.0, "i_deg": 60.0, "mean_anomaly_deg": 1.0}, "magnitude": 3.0}
    sensor = SENSOR | {
        "pointing": {"mode": "body", "azimuth_deg": 60.0, "elevation_deg": 20.0},
        "camera": {"fov_deg": 120.0}, "exposure_s": 0.5,
        "rate_hz": 200.0, "magnitude_limit": 4.0,
    }  # fmt: skip
    places = {}
    for error in (0.0, 0.1):
        detection = {"sigma_px": 1e-6, "trail_error": error, "false_points": 0.0}
        scene = scene_of(sensor | {"detection": detection}, targets=[target], duration_s=4.0)
        (seen,) = next(stage.expose_blocks(stage.simulate_scene(scene)))
        frame = np.repeat(seen.frame_number, np.diff(seen.offsets))
        is_target = seen.kind == TARGET
        order = np.argsort(frame[is_target])
        places[error] = np.stack([seen.x_px, seen.y_px], axis=1)[is_target][order]
        assert (seen.kind != FALSE).all()
    motion = np.gradient(places[0.0], axis=0) * 200.0 * 0.5  # px in an exposure
    length = np.linalg.norm(motion, axis=1)
    off = places[0.1] - places[0.0]
    along = np.einsum("ij,ij->i", off, motion) / length
    across = (off[:, 0] * motion[:, 1] - off[:, 1] * motion[:, 0]) / length
    assert len(off) == 800
    assert length.min() > 3.0
    assert np.std(along / length) == pytest.approx(0.1, rel=0.1)
    assert np.abs(across).max() < 0.02 * length.max()


def test_the_jitter_of_a_frame_is_not_a_trail():
    path = {"a_km": 7100.0, "i_deg": 60.0, "mean_anomaly_deg": 1.0}
    targets = [{"orbit": path, "magnitude": 3.0}]
    pointing = {"mode": "track", "target": 0, "jitter_arcsec": 300.0}
    sensor = SENSOR | {"pointing": pointing, "exposure_s": 0.5, "rate_hz": 10.0}
    places = {}
    for error in (0.0, 0.5):
        detection = {"sigma_px": 1e-6, "trail_error": error, "false_points": 0.0}
        scene = scene_of(sensor | {"detection": detection}, targets=targets, duration_s=4.0)
        (seen,) = next(stage.expose_blocks(stage.simulate_scene(scene)))
        frame = np.repeat(seen.frame_number, np.diff(seen.offsets))
        is_target = seen.kind == TARGET
        order = np.argsort(frame[is_target])
        places[error] = np.stack([seen.x_px, seen.y_px], axis=1)[is_target][order]
    assert len(places[0.5]) == 40
    assert np.abs(places[0.5] - places[0.0]).max() < 0.05  # it follows the object: no trail

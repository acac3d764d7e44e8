"""Simulated logs: the same again from the same seed, with the noise and losses they are told."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from epipole.flows.simulate import simulate
from epipole.io.logs.reader import read_log
from epipole.io.simulation.scenes import built_in_scenes, read_scene
from epipole.io.simulation.truth import read_truth
from epipole.schemas.bridge import array, flatten, stack
from epipole.schemas.errors import SceneError
from epipole.schemas.scene import parse_scene, validate_scene
from epipole.tasks.algorithms.simulation.constants import EARTH_RADIUS_KM
from epipole.tasks.algorithms.simulation.exposures import Exposing
from epipole.tasks.algorithms.simulation.orbits import state_at
from epipole.tasks.algorithms.simulation.sensor import frame_times
from epipole.tasks.algorithms.simulation.sightlines import hidden_by_earth
from epipole.tasks.algorithms.simulation.star_field import star_field, stars_in_cones
from epipole.tasks.simulate import simulate_scene as stage

ARCSEC = np.pi / 648000
SENSOR = {
    "id": "a",
    "orbit": {"a_km": 7000.0},
    "camera": {"fov_deg": 10.0},
    "pointing": {"mode": "fixed", "ra_deg": 10.0, "dec_deg": 5.0},
    "phase": 0.0,
}


def scene_of(sensor=None, **changes):
    scene = {"name": "test", "sensors": [SENSOR | (sensor or {})], "duration_s": 20.0}
    return validate_scene(scene | changes, "test")


def exposures(scene):
    """Return what each sensor of a scene sees, all of it in one block."""
    return next(stage.expose_blocks(stage.simulate_scene(scene)))


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path):
    for name, seed in (("one", 3), ("same", 3), ("other", 4)):
        simulate("six_sensor_wide", tmp_path / name / "n.mcap", seed=seed, hours=0.002)
    one, same, other = (contents(tmp_path / name) for name in ("one", "same", "other"))
    assert len(one) == 4
    assert one == same
    assert all(one[name] != other[name] for name in one)


def test_the_length_of_blocks_changes_nothing(tmp_path, monkeypatch):
    for name, frames in (("long", 4096), ("short", 11)):
        monkeypatch.setattr(stage, "FRAMES_AT_ONCE", frames)
        simulate("night", tmp_path / name / "n.mcap", sensors=6, hours=0.01)
    truths = [read_truth(tmp_path / name / "n.mcap") for name in ("long", "short")]
    assert in_order(truths[0].points).equals(in_order(truths[1].points))
    assert in_order(truths[0].frames).equals(in_order(truths[1].frames))
    logs = [read_log(tmp_path / name / "n.mcap") for name in ("long", "short")]
    assert logs[0].exposures.num_rows > 100
    assert logs[0].states.equals(logs[1].states)
    one, other = (log.exposures.drop_columns(["source", "offset"]) for log in logs)
    assert one.equals(other)


def in_order(rows):
    keys = [k for k in ("sensor_id", "frame_number", "centroid") if k in rows.column_names]
    return rows.sort_by([(key, "ascending") for key in keys]).combine_chunks()


@pytest.mark.parametrize("name", built_in_scenes())
def test_a_built_in_scene_is_written_with_its_truth(name, tmp_path):
    made = simulate(name, tmp_path / "n.mcap", hours=0.004)
    truth, log = read_truth(tmp_path / "n.mcap"), read_log(tmp_path / "n.mcap")
    assert made.frames == truth.frames.num_rows == log.exposures.num_rows > 0
    assert made.centroids == truth.points.num_rows == len(flatten(log.exposures, "x_px")[0]) > 0
    assert log.rejects.num_rows == 0
    assert len(truth.scenario["targets"]) == made.objects
    kinds = set(array(truth.points, "kind").tolist())
    assert kinds == ({0, 1, 2} if made.objects else {0, 2})


def test_options_take_the_place_of_what_the_scene_says(tmp_path):
    made = simulate(
        "night", tmp_path / "n.mcap", sensors=2, objects=5, hours=0.01, rate_hz=4.0, seed=1
    )
    assert (made.sensors, made.objects) == (2, 5)
    rates = [sensor["rate_hz"] for sensor in read_truth(made.truth).scenario["sensors"]]
    assert rates == [4.0, 4.0]


BAD_SCENES = {
    "sensors.0.camera: a camera takes one of": {"camera": {"fov_deg": 2.0, "focal_px": 100.0}},
    "sensors.0.orbit: the orbit's perigee lies below": {"orbit": {"a_km": 7000.0, "e": 0.5}},
    "sensors.0.orbit: an orbit takes one of": {"orbit": {"a_km": 7000.0, "random": "leo"}},
    "sensors.0.rate_hz = 0: input should be greater": {"rate_hz": 0},
    "unknown field sensors.0.colour": {"colour": "red"},
    "sensors.0.id = '../x': ": {"id": "../x"},
    'sensors.0.pointing: pointing "fixed" takes ra_deg': {"pointing": {"mode": "fixed"}},
    "sensor a tracks target 3 of 0": {"pointing": {"target": 3}},
    "sensors.0.detection.star_drop = 2.0: input": {"detection": {"star_drop": 2.0}},
}


@pytest.mark.parametrize("says", BAD_SCENES)
def test_a_bad_scene_is_one_line_that_names_the_field(says):
    with pytest.raises(SceneError, match="^test: .*" + re.escape(says)) as error:
        scene_of(BAD_SCENES[says])
    assert "\n" not in str(error.value)


def test_what_is_no_scene_is_said(tmp_path):
    with pytest.raises(SceneError, match=r"^x.toml: not TOML: "):
        parse_scene("name = ", "x.toml")
    with pytest.raises(SceneError, match=r"^x.toml: name is missing$"):
        parse_scene("duration_s = 3.0", "x.toml")
    with pytest.raises(SceneError, match=r"nor a built-in one \(.*night"):
        read_scene(tmp_path / "none.toml")
    two = scene_of(sensors=[SENSOR | {"id": "a", "count": 2}, SENSOR | {"id": "a1"}])
    with pytest.raises(SceneError, match="two sensors would be called a1"):
        stage.simulate_scene(two)
    away = {"position_km": (7000.0, 0.0, 0.0), "velocity_km_s": (0.0, 12.0, 0.0)}
    away = scene_of({"orbit": away})
    with pytest.raises(SceneError, match="faster than escape"):
        stage.simulate_scene(away)
    with pytest.raises(SceneError, match="has no targets to take 3 of"):
        simulate("lost_in_space", tmp_path / "n.mcap", objects=3)
    (tmp_path / "file").touch()
    with pytest.raises(SceneError, match=r"file/n.mcap: cannot be written"):
        simulate("lost_in_space", tmp_path / "file" / "n.mcap")


def test_a_scene_file_is_read_with_what_all_sensors_share(tmp_path):
    text = """
    name = "mine"
    [sensor_defaults]
    camera = { fov_deg = 9.0, k1 = -0.1 }
    pointing = { mode = "random" }
    [[sensors]]
    id = "a"
    orbit = { a_km = 7000.0 }
    [[sensors]]
    id = "b"
    orbit = { a_km = 7000.0 }
    camera = { k1 = 0.1 }
    """
    (tmp_path / "mine.toml").write_text(text)
    cameras = [sensor.camera for sensor in read_scene(tmp_path / "mine.toml").sensors]
    assert [(c.fov_deg, c.k1) for c in cameras] == [(9.0, -0.1), (9.0, 0.1)]


def test_the_earth_hides_what_a_walk_along_the_line_of_sight_runs_into():
    rng = np.random.default_rng(0)
    r_km = rng.normal(size=(400, 3))
    r_km *= (rng.uniform(6900, 12000, 400) / np.linalg.norm(r_km, axis=1))[:, None]
    target_km = rng.normal(size=(400, 3)) * 9000
    target_km = target_km[np.linalg.norm(target_km, axis=1) > 6500]
    r_km = r_km[: len(target_km)]
    d_km = target_km - r_km
    distance = np.linalg.norm(d_km, axis=1)
    walk = r_km[:, None] + np.linspace(0, 1, 4001)[None, :, None] * d_km[:, None]
    lowest = np.linalg.norm(walk, axis=2).min(axis=1)
    clear = np.abs(lowest - EARTH_RADIUS_KM) > 1.0  # steps of 10 km do not tell closer than so
    hidden = hidden_by_earth(r_km, d_km / distance[:, None], distance)
    assert 50 < hidden.sum() < len(hidden) - 50
    np.testing.assert_array_equal(hidden[clear], (lowest < EARTH_RADIUS_KM)[clear])


def test_nothing_is_seen_through_the_earth():
    beyond = {"orbit": {"a_km": 42164.0, "mean_anomaly_deg": 180.0}, "magnitude": 5.0}
    above = {"orbit": {"a_km": 42164.0, "mean_anomaly_deg": 40.0}, "magnitude": 5.0}
    sensor = {
        "orbit": {"a_km": 7000.0},
        "camera": {"fov_deg": 10.0},
        "detection": {"false_points": 0.0},
    }
    for target, there in ((beyond, False), (above, True)):
        (seen,) = exposures(scene_of(sensor | {"pointing": {"target": 0}}, targets=[target]))
        assert (len(seen.kind) > 0) is there
        assert (1 in seen.kind) is there


def test_a_sensor_that_skips_hidden_frames_takes_none_of_them():
    pointing = {"mode": "track", "orbit": {"a_km": 42164.0}}
    times = {}
    for skip in (False, True):
        scene = scene_of({"pointing": pointing | {"skip_hidden": skip}, "rate_hz": 0.1},
                         duration_s=6000.0)  # fmt: skip
        (times[skip],) = exposures(scene)
    empty = np.diff(times[False].offsets) == 0
    assert 0.2 < empty.mean() < 0.5
    assert set(times[True].frame_number) <= set(times[False].frame_number[~empty])


def little_sky(places_px, magnitudes, focal_px=585.0):
    """Return a sky of a few stars about (ra, dec) = (10, 5) degrees."""
    n = len(places_px)
    at = np.array(places_px, float) / focal_px
    ra = np.radians(10.0) + at[:, 0] / np.cos(np.radians(5.0))
    zeros = np.zeros(n)
    return star_field(
        np.arange(1, n + 1) * 100, ra, np.radians(5.0) + at[:, 1], zeros, zeros, zeros,
        np.array(magnitudes, float), epoch=1991.25, radius_rad=0.2,
    )  # fmt: skip


@pytest.mark.parametrize(("apart_px", "spots"), [(1.0, 1), (1.9, 1), (2.1, 2), (5.0, 2)])
def test_close_stars_are_one_spot_of_the_brighter_one_at_the_middle_of_the_light(apart_px, spots):
    camera = {"width": 1024, "height": 1024, "focal_px": 585.0}
    scene = scene_of({"camera": camera, "detection": {"sigma_px": 1e-9}})
    (sensor,) = stage.simulate_scene(scene).sensors
    number, time_ns = (v[:1] for v in frame_times(sensor))
    fainter = 2.5 * np.log10(3)  # a third of the light
    places = {}
    for name, sky in (
        ("both", little_sky([(0, 0), (0, apart_px)], [5.0 + fainter, 5.0])),
        ("first", little_sky([(0, 0)], [5.0])),
        ("second", little_sky([(0, apart_px)], [5.0])),
    ):
        seen = Exposing(sensor, sky, np.empty((0, 6)), np.empty(0)).expose(number, time_ns)
        places[name] = np.stack([seen.x_px, seen.y_px], axis=1), seen.source, seen.flux
    both, ids, flux = places["both"]
    first, second = places["first"][0][0], places["second"][0][0]
    assert np.linalg.norm(first - second) == pytest.approx(apart_px, rel=0.01)
    assert len(both) == spots
    if spots == 1:
        assert ids.tolist() == [200]
        np.testing.assert_allclose(both[0], 0.25 * first + 0.75 * second, atol=1e-6)
        assert flux[0] == pytest.approx(1e6 * 10**-2 * 4 / 3, rel=0.3)
    else:
        assert sorted(ids.tolist()) == [100, 200]


@pytest.mark.parametrize("radius_deg", [0.5, 7.0, 40.0])
def test_stars_in_cones_are_those_that_a_search_of_all_stars_finds(radius_deg):
    rng = np.random.default_rng(2)
    z = rng.uniform(-1, 1, 3000)
    zeros = np.zeros(3000)
    field = star_field(
        np.arange(3000), rng.uniform(0, 2 * np.pi, 3000), np.arcsin(z), zeros, zeros, zeros,
        zeros, epoch=1991.25, radius_rad=np.radians(radius_deg),
    )  # fmt: skip
    u = rng.normal(size=(40, 3))
    u = np.concatenate([u / np.linalg.norm(u, axis=1)[:, None], np.eye(3), -np.eye(3)])
    cone, star = stars_in_cones(field, u, np.radians(radius_deg))
    expected = np.argwhere(u @ field.place.T >= np.cos(np.radians(radius_deg)))
    order = np.lexsort((star, cone))
    np.testing.assert_array_equal(np.stack([cone, star], axis=1)[order], expected)


def spots_by_name(seen):
    frame = np.repeat(seen.frame_number, np.diff(seen.offsets))
    place = np.stack([seen.x_px, seen.y_px], axis=1)
    named = zip(frame.tolist(), seen.kind.tolist(), seen.source.tolist(), strict=True)
    return {key: i for i, key in enumerate(named) if key[1] < 2}, place


def test_noise_losses_and_false_points_are_as_told():
    told = {"sigma_px": 0.2, "star_drop": 0.1, "false_points": 4.0, "flux_error": 0.0}
    sensor = {"detection": told, "magnitude_limit": 8.5}
    scene = scene_of(sensor, duration_s=300.0)
    (noisy,) = exposures(scene)
    calm = {"detection": told | {"sigma_px": 1e-9, "star_drop": 0.0, "false_points": 0.0}}
    (clean,) = exposures(scene_of(sensor | calm, duration_s=300.0))
    a, place_a = spots_by_name(noisy)
    b, place_b = spots_by_name(clean)
    common = sorted(a.keys() & b.keys())
    off = (place_a[[a[k] for k in common]] - place_b[[b[k] for k in common]]) / 0.2
    n = off.size
    assert n > 10_000
    low, high = chi2(n).ppf([0.001, 0.999])
    assert low < np.sum(off**2) < high
    lost = 1 - len(common) / len(b)
    assert abs(lost - 0.1) < 4 * np.sqrt(0.09 / len(b))
    assert abs(np.sum(noisy.kind == 2) / 300 - 4.0) < 4 * np.sqrt(4.0 / 300)
    # Kinds cannot be told by their place in a message.
    first = noisy.kind[noisy.offsets[:-1]] == 2
    share = np.mean(noisy.kind == 2)
    assert abs(first.mean() - share) < 4 * np.sqrt(share / 300)


def test_hot_pixels_stay_where_they_are_and_outages_and_drops_lose_frames():
    sensor = {
        "detection": {"hot_pixels": 3, "sigma_px": 0.01},
        "outages_s": [(5.0, 15.0)],
        "frame_drop": 0.3,
    }
    (seen,) = exposures(scene_of(sensor, duration_s=400.0))
    t_s = (seen.time_ns - seen.time_ns[0]) / 1e9 + seen.frame_number[0]
    assert not np.any((t_s > 5.5) & (t_s < 14.5))
    assert abs(len(t_s) - 390 * 0.7) < 4 * np.sqrt(390 * 0.21)
    hot = np.stack([seen.x_px, seen.y_px], axis=1)[seen.kind == 2]
    assert len(np.unique(np.rint(hot), axis=0)) <= 3
    assert np.abs(hot - np.rint(hot)).max() < 0.06


def test_states_are_off_by_a_bias_of_each_sensor_and_noise_of_each_state(tmp_path):
    told = {"position_noise_km": 0.03, "position_bias_km": 0.5,
            "prior_noise_arcsec": 20.0, "prior_bias_arcsec": 300.0}  # fmt: skip
    made = simulate(scene_of({"states": told, "count": 30}), tmp_path / "n.mcap")
    states, frames = read_log(made.logs[0]).states, read_truth(made.truth).frames
    i, j = same_instants(states, frames)
    off_km = (stack(states, "{}_km")[i] - stack(frames, "{}")[j]).reshape(30, 20, 3)
    q_told, q_true = stack(states, "q{}", "xyzw")[i], stack(frames, "q{}", "xyzw")[j]
    turned = (Rotation.from_quat(q_told) * Rotation.from_quat(q_true).inv()).as_rotvec() / ARCSEC
    for off, noise, bias in ((off_km, 0.03, 0.5), (turned.reshape(30, 20, 3), 20.0, 300.0)):
        about_mean = off - off.mean(axis=1, keepdims=True)
        assert about_mean.std() * np.sqrt(20 / 19) == pytest.approx(noise, rel=0.1)
        assert off.mean(axis=1).std() == pytest.approx(bias, rel=0.3)  # of 90 numbers
    sent = array(states, "attitude_sigma_arcsec")
    np.testing.assert_allclose(sent, np.hypot(20.0, 300.0))


def same_instants(states, frames):
    """Return the rows of states and of frames at one time of one sensor, by sensor and time."""
    rows = [
        dict(zip(zip(t["sensor_id"].to_pylist(), array(t, name).tolist(), strict=True),
                 range(t.num_rows), strict=True))
        for t, name in ((states, "time"), (frames, "t_ns"))
    ]  # fmt: skip
    both = sorted(rows[0].keys() & rows[1].keys())
    return [rows[0][key] for key in both], [rows[1][key] for key in both]


def test_pointing_follows_stands_spins_and_jumps():
    target = {"orbit": {"a_km": 42164.0, "mean_anomaly_deg": 20.0}}
    axes = {}
    for mode, pointing in {
        "track": {"target": 0},
        "fixed": {"mode": "fixed", "ra_deg": 30.0, "dec_deg": 10.0},
        "spin": {"mode": "spin", "ra_deg": 30.0, "dec_deg": 10.0, "rate_deg_s": 2.0},
        "random": {"mode": "random"},
    }.items():
        scene = scene_of({"pointing": pointing}, targets=[target])
        simulation = stage.simulate_scene(scene)
        (seen,) = next(stage.expose_blocks(simulation))
        axes[mode] = seen.attitude.as_matrix()[:, 2]
        t_s = np.arange(20.0)
        if mode == "track":
            d_km = state_at(simulation.targets[0], t_s)[0] - seen.r_km
            along = d_km / np.linalg.norm(d_km, axis=1)[:, None]
            np.testing.assert_allclose(axes[mode], along, atol=1e-12)
    ra = np.degrees(np.unwrap(np.arctan2(axes["spin"][:, 1], axes["spin"][:, 0])))
    np.testing.assert_allclose(ra, 30.0 + 2.0 * t_s, atol=1e-9)
    np.testing.assert_allclose(axes["fixed"], axes["spin"][:1].repeat(20, axis=0), atol=1e-12)
    jumps = np.einsum("ij,ij->i", axes["random"][1:], axes["random"][:-1])
    assert len(np.unique(np.round(jumps, 6))) == 19


def test_the_true_optics_depart_from_those_sent_as_told(tmp_path):
    departure = {"focal": 0.01, "cx_px": 2.0, "k1": 0.02}
    camera = {"fov_deg": 10.0, "departure": departure}
    scene = scene_of({"camera": camera})
    made = simulate(scene, tmp_path / "n.mcap")
    (sent,) = read_log(made.logs[0]).cameras.to_pylist()
    true = read_truth(made.truth).scenario["sensors"][0]["camera"]
    assert true["fx_px"] == pytest.approx(sent["fx_px"] * 1.01)
    assert (true["cx_px"] - sent["cx_px"], true["k1"], sent["k1"]) == (2.0, 0.02, 0.0)

"""What simulated sensors see: with the noise, losses and pointing that the scene says."""

import numpy as np
import pytest
from scenes.simulated import SENSOR, scene_of
from scipy.stats import chi2

from epipole.flows.simulate import simulate
from epipole.io.logs.reader import read_log
from epipole.io.simulation.truth import read_truth
from epipole.schemas.errors import SceneError
from epipole.tasks.algorithms.simulation.exposures import Exposing
from epipole.tasks.algorithms.simulation.paths import two_body_paths
from epipole.tasks.algorithms.simulation.sensor import frame_times
from epipole.tasks.algorithms.simulation.sources import SimulatedObjects, star_field
from epipole.tasks.simulate import simulate_scene as stage

NO_OBJECTS = SimulatedObjects(two_body_paths(np.empty((0, 6))), np.empty(0), np.empty(0, bool))


def exposures(scene):
    """Return what each sensor of a scene sees, all of it in one block."""
    return next(stage.expose_blocks(stage.simulate_scene(scene)))


@pytest.mark.parametrize(
    ("scene", "options"),
    [
        ("night", {"sensors": 6, "hours": 0.01}),
        ("constellation", {"satellites": 4, "near": True, "objects": 4000, "seconds": 20.0}),
    ],
)
def test_the_length_of_blocks_changes_nothing(scene, options, tmp_path, monkeypatch):
    for name, frames in (("long", 4096), ("short", 11)):
        monkeypatch.setattr(stage, "FRAMES_AT_ONCE", frames)
        simulate(scene, tmp_path / name / "n.mcap", **options)
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


def test_a_scene_that_cannot_be_simulated_is_refused():
    two = scene_of(sensors=[SENSOR | {"id": "a", "count": 2}, SENSOR | {"id": "a1"}])
    with pytest.raises(SceneError, match="two sensors would be called a1"):
        stage.simulate_scene(two)
    for v_km_s, why in (
        ((0.0, 12.0, 0.0), "faster than escape velocity"),
        ((0.0, 0.0, 0.0), "straight up or down"),
        ((-1.0, 0.0, 0.0), "straight up or down"),
    ):
        away = {"position_km": (7000.0, 0.0, 0.0), "velocity_km_s": v_km_s}
        with pytest.raises(SceneError, match=why):
            stage.simulate_scene(scene_of({"orbit": away}))


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
        seen = Exposing(sensor, sky, NO_OBJECTS).expose(number, time_ns)
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
            d_km = simulation.objects.paths.at(t_s)[0] - seen.r_km
            along = d_km / np.linalg.norm(d_km, axis=1)[:, None]
            np.testing.assert_allclose(axes[mode], along, atol=1e-12)
    ra = np.degrees(np.unwrap(np.arctan2(axes["spin"][:, 1], axes["spin"][:, 0])))
    np.testing.assert_allclose(ra, 30.0 + 2.0 * t_s, atol=1e-9)
    np.testing.assert_allclose(axes["fixed"], axes["spin"][:1].repeat(20, axis=0), atol=1e-12)
    jumps = np.einsum("ij,ij->i", axes["random"][1:], axes["random"][:-1])
    assert len(np.unique(np.round(jumps, 6))) == 19


def test_body_fixed_and_place_pointing_hold_their_angles():
    body = {"mode": "body", "azimuth_deg": 90.0, "elevation_deg": 30.0}
    (seen,) = exposures(scene_of({"pointing": body}, duration_s=2000.0))
    r, v = (a / np.linalg.norm(a, axis=1)[:, None] for a in (seen.r_km, seen.v_km_s))
    across = np.cross(r, v)
    axes = seen.attitude.as_matrix()
    np.testing.assert_allclose(np.einsum("ij,ij->i", axes[:, 2], r), 0.5, atol=1e-12)
    np.testing.assert_allclose(np.einsum("ij,ij->i", axes[:, 2], across), 0.75**0.5, atol=1e-12)
    # Up in the image, -y, is away from the Earth: no part of it is along the motion.
    np.testing.assert_allclose(np.einsum("ij,ij->i", axes[:, 1], v), 0.0, atol=1e-12)
    assert (np.einsum("ij,ij->i", axes[:, 1], r) < 0).all()
    (up,) = exposures(scene_of({"pointing": body | {"elevation_deg": 90.0}}))
    assert np.isfinite(up.attitude.as_matrix()).all()
    np.testing.assert_allclose(up.attitude.as_matrix()[:, 2], up.r_km / 7000.0, atol=1e-9)
    place = np.array([9000.0, 9000.0, 100.0])
    (seen,) = exposures(scene_of({"pointing": {"place_km": tuple(place)}}))
    along = (place - seen.r_km) / np.linalg.norm(place - seen.r_km, axis=1)[:, None]
    np.testing.assert_allclose(seen.attitude.as_matrix()[:, 2], along, atol=1e-12)


def test_an_object_is_seen_where_it_is_near_enough_and_fainter_with_distance():
    # The sensor goes by below the object: 3,090 km are the limit.
    target = {"orbit": {"a_km": 9000.0, "mean_anomaly_deg": 20.0}, "standard_magnitude": 3.55}
    detection = {"flux_error": 0.0, "target_drop": 0.0, "sigma_px": 0.1}
    sensor = {
        "orbit": {"a_km": 8000.0},
        "pointing": {"target": 0},
        "detection": detection,
        "rate_hz": 0.1,
        "magnitude_limit": 6.0,
    }
    (seen,) = exposures(scene_of(sensor, targets=[target], duration_s=5000.0))
    simulation = stage.simulate_scene(scene_of(sensor, targets=[target]))
    r_km, _ = simulation.objects.paths.at((seen.time_ns - simulation.t0_ns) / 1e9)
    distance = np.linalg.norm(r_km - seen.r_km, axis=1)
    frame = np.repeat(np.arange(len(distance)), np.diff(seen.offsets))
    shown = frame[seen.kind == 1]
    magnitude = 6.0 - 2.5 * np.log10(seen.flux[seen.kind == 1] / 1e6 * 10 ** (0.4 * 6.0))
    np.testing.assert_allclose(magnitude, 3.55 + 5 * np.log10(distance[shown] / 1e3), atol=1e-3)
    limit_km = 1e3 * 10 ** ((6.0 - 3.55) / 5)
    assert set(shown) == set(np.flatnonzero(distance < limit_km))
    assert 10 < len(shown) < len(distance) - 10
    # With a limit of its own, half of the objects at the limit are detected.
    shown = {}
    for fade in (0.0, 0.5):
        soft = sensor | {"object_limit": 5.0, "detection": detection | {"fade": fade}}
        steady = {"orbit": target["orbit"], "magnitude": 5.0}
        (seen,) = exposures(scene_of(soft, targets=[steady], duration_s=2000.0))
        shown[fade] = np.sum(seen.kind == 1)
    assert shown[0.0] == 200
    assert abs(shown[0.5] - 100) < 4 * np.sqrt(50)


def test_shadow_and_phase_take_light_from_objects():
    sensor = {"orbit": {"a_km": 7000.0}, "pointing": {"target": 0}, "rate_hz": 0.05}
    target = {"orbit": {"a_km": 7000.0, "mean_anomaly_deg": 5.0}, "magnitude": 6.0}
    counts, flux = {}, {}
    for name in ("plain", "earth_shadow", "phase_law"):
        switch = {} if name == "plain" else {name: True}
        scene = scene_of(sensor, targets=[target], duration_s=5800.0, **switch)
        (seen,) = exposures(scene)
        counts[name], flux[name] = np.sum(seen.kind == 1), seen.flux[seen.kind == 1]
    # A low orbit in the plane of the Sun at the equinox is dark for some 35 of 97 minutes.
    assert counts["plain"] == 290
    assert 0.60 < counts["earth_shadow"] / counts["plain"] < 0.68
    assert counts["phase_law"] < counts["plain"]
    assert flux["phase_law"].min() < 0.5 * flux["plain"].min()

"""Simulated logs and their truth: the same again from the same seed, with what the scene says."""

import datetime
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from scenes.satellites import two_lines
from scenes.simulated import scene_of
from scipy.spatial.transform import Rotation

from epipole.flows.simulate import simulate
from epipole.io.logs.reader import read_log
from epipole.io.simulation.scenes import built_in_scenes
from epipole.io.simulation.truth import read_truth
from epipole.schemas.bridge import array, flatten, stack, to_polars
from epipole.schemas.errors import SceneError
from epipole.tasks.evaluate.matching import locate_objects

ARCSEC = np.pi / 648000
BUILT_IN = Path(__file__).parents[2] / "io" / "simulation" / "built_in"


def contents(folder):
    return {p.name: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_the_same_seed_gives_the_same_bytes_and_another_seed_others(tmp_path):
    for name, seed in (("one", 3), ("same", 3), ("other", 4)):
        simulate("six_sensor_wide", tmp_path / name / "n.mcap", seed=seed, hours=0.002)
    one, same, other = (contents(tmp_path / name) for name in ("one", "same", "other"))
    assert len(one) == 4
    assert one == same
    assert all(one[name] != other[name] for name in one)


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


def test_an_option_or_a_place_that_does_not_fit_is_refused(tmp_path):
    with pytest.raises(SceneError, match="has no targets, so their number"):
        simulate("lost_in_space", tmp_path / "n.mcap", objects=3)
    (tmp_path / "file").touch()
    with pytest.raises(SceneError, match=r"file/n.mcap: cannot be written"):
        simulate("lost_in_space", tmp_path / "file" / "n.mcap")


def test_a_scene_that_an_encoding_cannot_hold_is_refused_before_any_work(tmp_path):
    late = datetime.datetime(2038, 1, 19, 3, 14, tzinfo=datetime.UTC)
    with pytest.raises(SceneError, match=r"lost_in_space as ros2: .*no times after 2038-01-19"):
        simulate("lost_in_space", tmp_path / "n.mcap", encoding="ros2", start=late, seconds=9.0)
    text = (BUILT_IN / "lost_in_space.toml").read_text()
    rolling = tmp_path / "rolling.toml"
    rolling.write_text(text.replace("fov_deg = 20.3", "fov_deg = 20.3, line_time_s = 1e-5"))
    with pytest.raises(SceneError, match=r"as ros2: a CameraInfo has no line time"):
        simulate(rolling, tmp_path / "n.mcap", encoding="ros2", seconds=1.0)
    assert [path.name for path in tmp_path.iterdir()] == ["rolling.toml"]


def test_a_scene_is_not_overwritten_by_its_log(tmp_path):
    scene = tmp_path / "scene.mcap"
    scene.write_bytes((BUILT_IN / "lost_in_space.toml").read_bytes())
    with pytest.raises(SceneError, match="is the scene itself; give another file"):
        simulate(scene, tmp_path / "." / "scene.mcap")
    assert scene.read_bytes() == (BUILT_IN / "lost_in_space.toml").read_bytes()


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


@pytest.mark.parametrize("told", [False, True])
def test_a_fault_is_in_the_states_and_in_the_sigma_only_where_it_is_told(told, tmp_path):
    faults = {"position_offset_km": 3.0, "position_told": told,
              "prior_offset_arcsec": (0.0, 0.0, 600.0), "prior_told": told}  # fmt: skip
    quiet = {"position_noise_km": 0.001, "position_bias_km": 0.0, "prior_noise_arcsec": 1.0}
    made = simulate(scene_of({"states": quiet, "faults": faults}), tmp_path / "n.mcap")
    states, frames = read_log(made.logs[0]).states, read_truth(made.truth).frames
    i, j = same_instants(states, frames)
    off_km = stack(states, "{}_km")[i] - stack(frames, "{}")[j]
    assert np.linalg.norm(off_km, axis=1) == pytest.approx(3.0, abs=0.01)
    assert np.ptp(off_km, axis=0).max() < 0.01
    q_told, q_true = stack(states, "q{}", "xyzw")[i], stack(frames, "q{}", "xyzw")[j]
    turned = (Rotation.from_quat(q_told) * Rotation.from_quat(q_true).inv()).as_rotvec() / ARCSEC
    np.testing.assert_allclose(turned, [[0.0, 0.0, 600.0]] * len(i), atol=5.0)
    sigmas = array(states, "position_sigma_km"), array(states, "attitude_sigma_arcsec")
    expected = (3.0 / 3**0.5, 600.0 / 3**0.5) if told else (0.001, 1.0)
    for sigma, value in zip(sigmas, expected, strict=True):
        assert sigma == pytest.approx(value, rel=1e-4)
    sensor = read_truth(made.truth).scenario["sensors"][0]
    np.testing.assert_allclose(sensor["pos_off_km"], off_km.mean(axis=0), atol=0.001)
    assert sensor["prior_bias_vec_arcsec"] == pytest.approx([0.0, 0.0, 600.0])


def test_the_truth_of_real_satellites_is_sampled_and_agrees_with_the_frames(tmp_path):
    made = simulate("real_leo", tmp_path / "n.mcap", hours=0.003)
    truth = read_truth(made.truth)
    assert truth.orbits.num_rows == 30 * len(set(array(truth.orbits, "t_ns").tolist()))
    names = [target["name"] for target in truth.scenario["targets"]]
    assert names[0] == "ONEWEB-0023"
    assert truth.scenario["sensors"][1]["norad_id"] == 42969
    # Each spot lies in its frame where the sampled orbit puts the object: a pinhole, no lens.
    shown = to_polars(truth.points).filter(pl.col("kind") == 1)
    spots = shown.join(to_polars(truth.frames), on=["sensor_id", "frame_number"])
    t_ns, source = spots["t_ns"].to_numpy(), spots["source"].to_numpy()
    r_km, _ = locate_objects(truth, source, t_ns)
    d = r_km - spots.select("x", "y", "z").to_numpy()
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    seen = Rotation.from_quat(spots.select("qx", "qy", "qz", "qw").to_numpy()).apply(d)
    assert spots.height > 200
    assert (np.abs(seen[:, :2] / seen[:, 2:]) < np.tan(np.radians(10.1))).all()
    # Objects on two-body orbits are among them where there are both kinds.
    kepler = {"orbit": {"a_km": 42164.0, "mean_anomaly_deg": 30.0}, "magnitude": 5.0}
    real = {"orbit": {"elements": "real_leo.tle"}, "count": 2, "magnitude": 5.0}
    scene = scene_of({"pointing": {"target": 2}}, targets=[real, kepler, real],
                     start="2026-05-30T12:00:00Z", duration_s=5.0)  # fmt: skip
    both = read_truth(simulate(scene, tmp_path / "n.mcap").truth)
    assert set(array(both.orbits, "object").tolist()) == {0, 1, 2, 3, 4}
    r_km, _ = locate_objects(both, np.array([2]), np.array([both.scenario["t0_ns"]]))
    np.testing.assert_allclose(r_km[0, :2], [42164 * 0.75**0.5, 21082.0], atol=1e-3)
    # A log made again without such satellites leaves no sampled orbits behind.
    simulate("four_sensor_geo", tmp_path / "n.mcap", hours=0.001)
    assert read_truth(made.truth).orbits is None


def same_instants(states, frames):
    """Return the rows of states and of frames at one time of one sensor, by sensor and time."""
    rows = [
        dict(zip(zip(t["sensor_id"].to_pylist(), array(t, name).tolist(), strict=True),
                 range(t.num_rows), strict=True))
        for t, name in ((states, "time"), (frames, "t_ns"))
    ]  # fmt: skip
    both = sorted(rows[0].keys() & rows[1].keys())
    return [rows[0][key] for key in both], [rows[1][key] for key in both]


def test_the_true_optics_depart_from_those_sent_as_told(tmp_path):
    departure = {"focal": 0.01, "cx_px": 2.0, "k1": 0.02}
    camera = {"fov_deg": 10.0, "departure": departure}
    scene = scene_of({"camera": camera})
    made = simulate(scene, tmp_path / "n.mcap")
    (sent,) = read_log(made.logs[0]).cameras.to_pylist()
    true = read_truth(made.truth).scenario["sensors"][0]["camera"]
    assert true["fx_px"] == pytest.approx(sent["fx_px"] * 1.01)
    assert (true["cx_px"] - sent["cx_px"], true["k1"], sent["k1"]) == (2.0, 0.02, 0.0)


def test_several_logs_of_a_night_have_one_truth(tmp_path):
    made = simulate("four_sensor_geo", tmp_path / "n.mcap", logs=3)
    assert [p.name for p in made.logs] == ["n-1.mcap", "n-2.mcap", "n-3.mcap"]
    assert read_truth(tmp_path / "n.mcap").frames.num_rows == made.frames == 240


def test_a_constellation_is_a_folder_with_a_log_for_each_satellite(tmp_path):
    made = simulate("constellation", tmp_path / "logs", satellites=3, objects=300, seconds=5.0)
    assert [log.name for log in made.logs] == ["s001.mcap", "s002.mcap", "s003.mcap"]
    assert made.truth == tmp_path / "logs.truth"
    assert (made.sensors, made.objects) == (6, 303)
    truth = read_truth(tmp_path / "logs")
    assert {s["sat"] for s in truth.scenario["sensors"]} == {"s001", "s002", "s003"}
    # All in one log: the same exposures.
    simulate("constellation", tmp_path / "n.mcap", satellites=3, objects=300, seconds=5.0)
    one = to_polars(read_log(tmp_path / "n.mcap").exposures).drop("source", "offset")
    parts = [to_polars(read_log(log).exposures).drop("source", "offset") for log in made.logs]
    keys = ["sensor_id", "frame_number"]
    assert pl.concat(parts).sort(keys).equals(one.sort(keys))
    assert set(pl.concat(parts)["sensor_id"]) == {f"s00{k}{t}" for k in (1, 2, 3) for t in "ab"}
    with pytest.raises(SceneError, match="logs: has other files, such as s003"):
        simulate("constellation", tmp_path / "logs", satellites=2, seconds=1.0)
    with pytest.raises(SceneError, match="a folder has one log for each satellite"):
        simulate("constellation", tmp_path / "x", satellites=2, logs=2)


def test_a_catalogue_takes_the_place_of_random_objects_without_what_cannot_be_used(tmp_path):
    lines = [("NEW", two_lines("11", 15.0)), ("OLD", two_lines("12", 15.0, days=-40.0)),
             ("FALLING", two_lines("13", 16.9, bstar=1.0, days=-1.0))]  # fmt: skip
    file = tmp_path / "some.tle"
    file.write_text("\n".join(f"{name}\n" + "\n".join(each) for name, each in lines))
    made = simulate("constellation", tmp_path / "logs", satellites=2, elements=file, seconds=2.0)
    targets = read_truth(made.truth).scenario["targets"]
    assert [(t["object"], t["name"], t.get("norad")) for t in targets] == [
        (0, "NEW", 11), (1, "s001", None), (2, "s002", None)
    ]  # fmt: skip


def test_options_of_a_constellation_are_refused_elsewhere(tmp_path):
    for options in ({"satellites": 3}, {"near": True}):
        with pytest.raises(SceneError, match="night: is no constellation"):
            simulate("night", tmp_path / "n.mcap", **options)
    with pytest.raises(SceneError, match="give satellites instead of sensors"):
        simulate("constellation", tmp_path / "n.mcap", sensors=3)
    with pytest.raises(SceneError, match="hours or seconds, not both"):
        simulate("night", tmp_path / "n.mcap", hours=1.0, seconds=1.0)
    with pytest.raises(SceneError, match="has no targets that element sets could replace"):
        simulate("lost_in_space", tmp_path / "n.mcap", elements="real_leo.tle")

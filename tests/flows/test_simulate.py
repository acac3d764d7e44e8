"""Simulated logs and their truth: the same again from the same seed, with what the scene says."""

import numpy as np
import pytest
from scenes.simulated import scene_of
from scipy.spatial.transform import Rotation

from epipole.flows.simulate import simulate
from epipole.io.logs.reader import read_log
from epipole.io.simulation.scenes import built_in_scenes
from epipole.io.simulation.truth import read_truth
from epipole.schemas.bridge import array, flatten, stack
from epipole.schemas.errors import SceneError

ARCSEC = np.pi / 648000


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

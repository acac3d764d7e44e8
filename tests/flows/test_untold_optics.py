"""A night whose log tells the optics wrong: attitudes say how wrong they are, positions hold."""

import numpy as np
import polars as pl
import pytest
from scipy.spatial.transform import Rotation

from epipole.flows.evaluate import evaluate
from epipole.flows.nightly import nightly
from epipole.flows.simulate import simulate
from epipole.schemas.scene import validate_scene

pytestmark = pytest.mark.long

GEO_KM = [-39353.5, 15130.6, 452.2]
N_SENSORS = 4


def scene(seed):
    """Four sensors with another lens than the log says, and a principal point off by 5 px."""
    rng = np.random.default_rng(seed)
    sensors = []
    for k in range(N_SENSORS):
        turn = rng.uniform(0, 2 * np.pi)
        off = {"focal": 0.004, "k1": -0.3, "cx_px": 5 * np.cos(turn), "cy_px": 5 * np.sin(turn)}
        camera = {"width": 1024, "height": 1024, "fov_deg": 12.0, "departure": off}
        sensors.append({"id": f"s{k}", "orbit": {"random": "leo"}, "camera": camera})
    defaults = {
        "in_view": True, "magnitude_limit": 6.6, "object_limit": 7.5,
        "pointing": {"mode": "track", "orbit": {"position_km": GEO_KM}},
        "detection": {"sigma_px": 0.15, "false_points": 1.0, "star_drop": 0.05},
    }  # fmt: skip
    target = {"orbit": {"position_km": GEO_KM}, "count": 8, "spread_km": 700.0}
    whole = {"name": "untold", "duration_s": 30.0, "seed": seed, "sensor_defaults": defaults}
    return validate_scene(
        whole | {"sensors": sensors, "targets": [target | {"magnitude": [5.0, 7.0]}]}, "test"
    )


@pytest.fixture(scope="module")
def night(prefect, tmp_path_factory):
    folder = tmp_path_factory.mktemp("untold")
    made = simulate(scene(3), folder / "n.mcap")
    nightly([str(log) for log in made.logs], str(folder / "out"))
    return made, folder / "out"


def test_attitudes_are_as_uncertain_as_their_errors_are_large(night):
    made, out = night
    frames = pl.read_parquet(f"{out}/night=*/frames/*.parquet").join(
        pl.read_parquet(f"{made.truth}/frames.parquet"),
        on=["sensor_id", "frame_number"], suffix="_true",
    )  # fmt: skip
    assert (frames["attitude_source"] == "stars").all()
    got, true = (
        Rotation.from_quat(frames.select(f"q{a}{end}" for a in "xyzw").to_numpy())
        for end in ("", "_true")
    )
    off = np.degrees((got * true.inv()).as_rotvec()) * 3600
    sigma = frames.select(f"sigma_{a}_arcsec" for a in "xyz").to_numpy()
    # 5 px are 210 arcsec; the errors of a sensor are one draw, shared by its frames.
    assert np.abs(off[:, :2]).max() > 100
    assert np.abs(off / sigma).max() < 5
    assert 0.2 < np.mean((off[:, :2] / sigma[:, :2]) ** 2) < 3


def test_positions_hold_and_are_honest(night):
    made, out = night
    found = evaluate(out, made.truth).as_dict()
    assert found["pair_precision"] > 0.99
    assert found["object_recall"] > 0.95
    assert found["nees_in_99"] > 0.93
    assert found["pos_err_km_median"] < 3.0  # 1 arcsec is 0.2 km, and few views cross well

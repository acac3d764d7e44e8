"""Classify detections: planets, put into a log at the places of JPL's ephemeris."""

import numpy as np
import polars as pl
import pytest

from epipole.schemas.scene import validate_scene
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.times import tt_julian_date

jplephem = pytest.importorskip("jplephem")
de421 = pytest.importorskip("de421")

PLANETS = ("venus", "mars", "jupiter", "saturn")
START_NS = 1_554_091_200_000_000_000  # 2019-04-01T04:00:00Z
SIGMA_PX = 0.15


@pytest.fixture(scope="module")
def sky():
    return jplephem.Ephemeris(de421)


def barycentric(sky, body, time_ns):
    """Position [km] of a body, Earth included, at UTC times; TT serves as TDB (2 ms)."""
    date, fraction = tt_julian_date(np.atleast_1d(time_ns))
    if body != "earth":
        return sky.position(body, date + fraction).T
    moon = sky.position("moon", date + fraction)
    return (sky.position("earthmoon", date + fraction) - moon / (1 + sky.EMRAT)).T


def apparent(sky, body, time_ns, r_km, v_km_s):
    """Directions in which a sensor sees a planet: light time, then aberration, first order."""
    here = barycentric(sky, "earth", time_ns) + r_km
    delay_s = np.zeros(len(time_ns))
    for _ in range(3):
        line = barycentric(sky, body, time_ns - (delay_s * 1e9).astype(np.int64)) - here
        delay_s = np.linalg.norm(line, axis=1) / SPEED_OF_LIGHT_KM_S
    half_ns = 500_000_000
    earth = [barycentric(sky, "earth", time_ns + s * half_ns) for s in (-1, 1)]
    u = line / np.linalg.norm(line, axis=1)[:, None]
    u = u + (earth[1] - earth[0] + v_km_s) / SPEED_OF_LIGHT_KM_S
    return u / np.linalg.norm(u, axis=1)[:, None]


def scene(sky):
    """High sensors that each point at a planet, without an object near it."""
    sensors = []
    at = np.array([START_NS])
    for k, planet in enumerate(PLANETS):
        u = apparent(sky, planet, at, np.zeros((1, 3)), np.zeros((1, 3)))[0]
        away = -np.cross(u, [0, 0, 1.0])  # off the Earth's side of the sight
        away *= 42164 / np.linalg.norm(away)
        sensors.append(
            {
                "id": planet,
                "orbit": {"position_km": away.tolist()},
                "magnitude_limit": 7.0,
                "camera": {"width": 1024, "height": 1024, "fov_deg": 8.0},
                "detection": {"sigma_px": SIGMA_PX, "false_points": 1.0},
                "pointing": {
                    "mode": "fixed",
                    "ra_deg": float(np.degrees(np.arctan2(u[1], u[0]))) + 0.7 * k / 3,
                    "dec_deg": float(np.degrees(np.arcsin(u[2]))) + 0.5,
                },
            }
        )
    return validate_scene(
        {"name": "planets", "duration_s": 30.0, "seed": 4, "sensors": sensors}, "test"
    )


def with_planets(sky, log, out):
    """Write a copy of a log with a planet as the last centroid of each frame."""
    from scenes.whole_logs import read_whole

    from epipole.io.logs.writer import LogWriter
    from epipole.schemas.bridge import array
    from epipole.schemas.settings import Settings

    read = read_whole([str(log)], Settings())
    truth = pl.read_parquet(f"{log}.truth/frames.parquet")
    true = {(row["sensor_id"], row["frame_number"]): row for row in truth.iter_rows(named=True)}
    cameras = {row["sensor_id"]: row for row in read.cameras.drop_columns("time").to_pylist()}
    rng = np.random.default_rng(0)
    with LogWriter(out) as writer:
        for name, camera in cameras.items():
            writer.camera(name, START_NS, {k: v for k, v in camera.items() if k != "sensor_id"})
        for time_ns, row in zip(
            array(read.states, "time").tolist(), read.states.drop_columns("time").to_pylist(),
            strict=True,
        ):  # fmt: skip
            writer.state(
                row["sensor_id"], time_ns,
                position_km=[row[f"{a}_km"] for a in "xyz"],
                velocity_km_s=[row[f"v{a}_km_s"] for a in "xyz"],
                position_sigma_km=row["position_sigma_km"],
            )  # fmt: skip
        for time_ns, row in zip(
            array(read.exposures, "time").tolist(),
            read.exposures.drop_columns("time").to_pylist(), strict=True,
        ):  # fmt: skip
            name, camera = row["sensor_id"], cameras[row["sensor_id"]]
            here = true[name, row["frame_number"]]
            r, v = (np.array([[here[f"{p}{a}"] for a in "xyz"]]) for p in ("", "v"))
            u = apparent(sky, name, np.array([time_ns]), r, v)[0]
            place = rotated(here, u)
            x, y = (
                camera[f"f{a}_px"] * place[i] / place[2] + camera[f"c{a}_px"]
                for i, a in enumerate("xy")
            )
            noise = rng.normal(size=2) * SIGMA_PX
            writer.frame(
                name, time_ns, frame_number=row["frame_number"], exposure_s=row["exposure_s"],
                x_px=[*row["x_px"], x + noise[0]], y_px=[*row["y_px"], y + noise[1]],
                flux=[*row["flux"], 1e6], sigma_px=[*row["sigma_px"], SIGMA_PX],
            )  # fmt: skip


def rotated(frame, u):
    """Turn a direction into sensor axes by the frame's true attitude."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_quat([frame[f"q{a}"] for a in "xyzw"]).apply(u)


@pytest.fixture(scope="module")
def found(prefect, sky, tmp_path_factory):
    from epipole.flows.nightly import nightly
    from epipole.flows.simulate import simulate

    folder = tmp_path_factory.mktemp("planets")
    simulate(scene(sky), folder / "bare.mcap")
    with_planets(sky, folder / "bare.mcap", folder / "planets.mcap")
    nightly([str(folder / "planets.mcap")], str(folder / "out"))
    last = pl.read_parquet(folder / "bare.mcap.truth/points.parquet").group_by(
        "sensor_id", "frame_number"
    ).agg(centroid=pl.col("centroid").max() + 1)  # fmt: skip
    detections = pl.read_parquet(folder / "out/night=*/detections/*.parquet")
    return detections, last


@pytest.mark.parametrize("planet", PLANETS)
def test_a_planet_is_a_planet_in_every_frame(found, planet):
    detections, last = found
    key = ["sensor_id", "frame_number", "centroid"]
    seen = detections.filter(pl.col("sensor_id") == planet).join(last, on=key, how="semi")
    assert len(seen) >= 29
    assert seen["kind"].to_list() == ["planet"] * len(seen)
    assert seen["tracklet_id"].null_count() == len(seen)


def test_nothing_else_is_taken_for_a_planet(found):
    detections, last = found
    others = detections.join(last, on=["sensor_id", "frame_number", "centroid"], how="anti")
    assert (others["kind"] == "planet").mean() < 0.05

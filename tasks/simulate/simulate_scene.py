"""Simulate a scene: its sensors and objects, and block by block what the sensors see.

These are plain functions, not Prefect tasks, because a simulation is not scheduled and streams its
results.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.io.simulation.sky import SkyStars, read_stars
from epipole.schemas.bridge import table, unstack
from epipole.schemas.errors import SceneError
from epipole.schemas.simulation.scene import Orbit, Scene, SceneCamera, SceneSensor
from epipole.schemas.work_tables import TRUE_FRAMES, TRUE_POINTS
from epipole.tasks.algorithms.simulation.constants import ARCSEC, GM_KM3_S2, SECOND_NS
from epipole.tasks.algorithms.simulation.exposures import Exposing, Exposures
from epipole.tasks.algorithms.simulation.optics import TrueOptics, field_radius
from epipole.tasks.algorithms.simulation.orbits import (
    circular_velocity,
    elements_from_state,
    mean_from_true_anomaly,
    state_at,
)
from epipole.tasks.algorithms.simulation.sensor import (
    SimulatedSensor,
    frame_times,
    random_stream,
)
from epipole.tasks.algorithms.simulation.sightlines import hidden_by_earth
from epipole.tasks.algorithms.simulation.star_field import StarField, star_field

Array = npt.NDArray[np.float64]

FRAMES_AT_ONCE = 4096
NO_SENSOR = 1_000_000  # first index of the random streams that belong to no sensor
_DRAWS = 10_000


@dataclass(frozen=True)
class Simulation:
    """A scene whose random choices have been made."""

    scene: Scene
    t0_ns: int
    sensors: list[SimulatedSensor]
    groups: list[SceneSensor]  # the group of the scene that each sensor belongs to
    targets: Array  # (n, 6) elements at t0
    target_magnitude: Array


def simulate_scene(scene: Scene) -> Simulation:
    """Return the sensors and objects of a scene. The same scene always gives the same ones."""
    t0_ns = round(scene.start.timestamp() * 1e6) * 1000
    targets, magnitude = _targets(scene)
    sensors: list[SimulatedSensor] = []
    groups: list[SceneSensor] = []
    for group in scene.sensors:
        for number in range(1, group.count + 1):
            name = group.id if group.count == 1 else f"{group.id}{number}"
            sensors.append(_sensor(scene, group, name, len(sensors), t0_ns, targets))
            groups.append(group)
    names = [s.sensor_id for s in sensors]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise SceneError(f"{scene.name}: two sensors would be called {twice}")
    return Simulation(scene, t0_ns, sensors, groups, targets, magnitude)


def expose_blocks(simulation: Simulation) -> Iterator[list[Exposures]]:
    """Yield what each sensor sees, in blocks of time that limit the memory."""
    faintest = max(s.magnitude_limit for s in simulation.sensors)
    stars = read_stars(simulation.scene.catalogue, faintest)
    fields: dict[tuple[float, float], StarField] = {}
    work = []
    for sensor in simulation.sensors:
        key = (sensor.magnitude_limit, field_radius(sensor.optics))
        if key not in fields:
            fields[key] = _field(stars, *key)
        exposing = Exposing(sensor, fields[key], simulation.targets, simulation.target_magnitude)
        work.append((exposing, *frame_times(sensor)))
    rate = sum(s.rate_hz for s in simulation.sensors)
    step_ns = max(int(FRAMES_AT_ONCE / rate * SECOND_NS), 1)
    last_ns = max((int(t[-1]) for _, _, t in work if len(t)), default=simulation.t0_ns - 1)
    for low in range(simulation.t0_ns, last_ns + 1, step_ns):
        block = []
        for exposing, number, time_ns in work:
            part = slice(*np.searchsorted(time_ns, [low, low + step_ns]))
            block.append(exposing.expose(number[part], time_ns[part]))
        yield block


def true_tables(sensor_id: str, exposed: Exposures) -> tuple[pa.Table, pa.Table]:
    """Return the truth of a block of one sensor: TRUE_FRAMES and TRUE_POINTS."""
    q = exposed.attitude.as_quat()
    q = np.where(q[:, 3:] < 0, -q, q)
    n = np.diff(exposed.offsets)
    frames = table(
        TRUE_FRAMES,
        {
            "sensor_id": [sensor_id] * len(q),
            "frame_number": exposed.frame_number,
            "t_ns": exposed.time_ns,
            **unstack("q{}", q, "xyzw"),
            **unstack("{}", exposed.r_km),
            **unstack("v{}", exposed.v_km_s),
        },
    )
    first = np.repeat(exposed.offsets[:-1], n)
    points = table(
        TRUE_POINTS,
        {
            "sensor_id": pa.repeat(pa.scalar(sensor_id), len(first)),
            "frame_number": np.repeat(exposed.frame_number, n),
            "centroid": (np.arange(len(first)) - first).astype(np.int32),
            "kind": exposed.kind,
            "source": exposed.source,
        },
    )
    return frames, points


def sent_optics(camera: SceneCamera) -> TrueOptics:
    """Return the optics that the log reports."""
    if camera.focal_px is not None:
        focal = camera.focal_px
    else:
        focal = camera.width / 2 / math.tan(math.radians(camera.fov_deg or 0.0) / 2)
    cx = (camera.width - 1) / 2 if camera.cx_px is None else camera.cx_px
    cy = (camera.height - 1) / 2 if camera.cy_px is None else camera.cy_px
    lens = camera.k1, camera.k2, camera.p1, camera.p2, camera.k3
    return TrueOptics(camera.width, camera.height, focal, focal, cx, cy, *lens)


def true_optics(camera: SceneCamera) -> TrueOptics:
    """Return the true optics, which make the image."""
    sent, off = sent_optics(camera), camera.departure
    return sent._replace(
        fx_px=sent.fx_px * (1 + off.focal),
        fy_px=sent.fy_px * (1 + off.focal),
        **{
            name: getattr(sent, name) + getattr(off, name)
            for name in ("cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3")
        },
    )


def _field(stars: SkyStars, magnitude_limit: float, radius_rad: float) -> StarField:
    bright = stars.magnitude <= magnitude_limit
    return star_field(
        stars.star_id[bright],
        stars.ra[bright],
        stars.dec[bright],
        stars.pm_ra_mas_yr[bright],
        stars.pm_dec_mas_yr[bright],
        stars.parallax_mas[bright],
        stars.magnitude[bright],
        epoch=stars.epoch,
        radius_rad=radius_rad,
    )


def _elements(orbit: Orbit, rng: np.random.Generator) -> Array:
    """Return the (6,) elements of an orbit. Only a random orbit draws from `rng`."""
    if orbit.random is not None:
        return _random_elements(orbit.random, rng)
    if orbit.position_km is not None:
        r_km = np.array(orbit.position_km)
        v = orbit.velocity_km_s
        v_km_s = circular_velocity(r_km) if v is None else np.array(v)
        if v_km_s @ v_km_s >= 2 * GM_KM3_S2 / np.linalg.norm(r_km):
            raise SceneError(f"velocity_km_s {v}: faster than escape velocity")
        return elements_from_state(r_km, v_km_s)
    angles = np.radians([orbit.i_deg, orbit.raan_deg, orbit.argp_deg])
    if orbit.true_anomaly_deg is not None:
        mean = mean_from_true_anomaly(math.radians(orbit.true_anomaly_deg), orbit.e)
    else:
        mean = math.radians(orbit.mean_anomaly_deg or 0.0)
    return np.array([orbit.a_km, orbit.e, *angles, mean], float)


def _random_elements(kind: str, rng: np.random.Generator) -> Array:
    a_low, a_high, e, tilt = {
        "leo": (6900.0, 7600.0, 0.002, np.radians(100.0)),
        "meo": (20000.0, 30000.0, 0.02, np.radians(65.0)),
        "geo": (42120.0, 42210.0, 0.0005, np.radians(8.0)),
    }[kind]
    u = rng.random(6)
    i = tilt * u[2] if kind != "leo" else np.radians(30.0) + (tilt - np.radians(30.0)) * u[2]
    return np.array([a_low + (a_high - a_low) * u[0], e * u[1], i, *(2 * np.pi * u[3:])])


def _targets(scene: Scene) -> tuple[Array, Array]:
    elements, magnitudes = [np.empty((0, 6))], [np.empty(0)]
    for k, group in enumerate(scene.targets):
        rng = random_stream(scene.seed, NO_SENSOR + k, "targets")
        made = np.array([_spread(group.orbit, group.spread_km, rng) for _ in range(group.count)])
        elements.append(made.reshape(-1, 6))
        low, high = np.broadcast_to(np.asarray(group.magnitude, float), 2)
        magnitudes.append(low + (high - low) * rng.random(group.count))
    return np.concatenate(elements), np.concatenate(magnitudes)


def _spread(orbit: Orbit, spread_km: float, rng: np.random.Generator) -> Array:
    elements = _elements(orbit, rng)
    if not spread_km:
        return elements
    r_km, v_km_s = state_at(elements, np.zeros(()))
    moved = r_km + rng.standard_normal(3) * spread_km
    # The same direction of motion, but horizontal and circular at the new position.
    level = v_km_s - moved * (v_km_s @ moved) / (moved @ moved)
    speed = np.linalg.norm(circular_velocity(moved))
    return elements_from_state(moved, level / np.linalg.norm(level) * speed)


def _sensor(
    scene: Scene, group: SceneSensor, name: str, index: int, t0_ns: int, targets: Array
) -> SimulatedSensor:
    rng = random_stream(scene.seed, index, "sensor")
    pointing, detection, states = group.pointing, group.detection, group.states
    phase = float(rng.random()) if group.phase is None else group.phase
    if pointing.target is not None:
        followed = targets[pointing.target]
    else:
        followed = _elements(pointing.orbit, rng) if pointing.orbit else np.zeros(6)
    ra, dec = math.radians(pointing.ra_deg or 0.0), math.radians(pointing.dec_deg or 0.0)
    noise_arcsec = states.prior_noise_arcsec
    return SimulatedSensor(
        sensor_id=name,
        index=index,
        seed=scene.seed,
        t0_ns=t0_ns,
        duration_s=scene.duration_s,
        elements=_sensor_elements(scene, group, followed, rng),
        optics=true_optics(group.camera),
        mode=pointing.mode,
        followed=followed,
        up=np.array(pointing.up),
        roll=math.radians(pointing.roll_deg),
        boresight=np.array(
            [math.cos(dec) * math.cos(ra), math.cos(dec) * math.sin(ra), math.sin(dec)]
        ),
        axis=np.array(pointing.axis),
        spin_rate=math.radians(pointing.rate_deg_s),
        hold_s=pointing.hold_s or 1 / group.rate_hz,
        clearance=_radians(pointing.clear_of_earth_deg),
        skip_hidden=pointing.skip_hidden,
        jitter=pointing.jitter_arcsec * ARCSEC,
        rate_hz=group.rate_hz,
        phase=phase,
        exposure_s=group.exposure_s,
        time_jitter_s=group.time_jitter_s,
        frame_drop=group.frame_drop,
        outages_s=tuple(group.outages_s),
        magnitude_limit=group.magnitude_limit,
        sigma_px=detection.sigma_px,
        faint_sigma_px=detection.faint_sigma_px,
        flux_error=detection.flux_error,
        false_points=detection.false_points,
        hot_pixels=detection.hot_pixels,
        star_drop=detection.star_drop,
        target_drop=detection.target_drop,
        state_rate_hz=states.rate_hz,
        state_margin_s=states.margin_s,
        position_noise_km=states.position_noise_km,
        position_bias_km=states.position_bias_km,
        prior_noise=None if noise_arcsec is None else noise_arcsec * ARCSEC,
        prior_bias=states.prior_bias_arcsec * ARCSEC,
    )


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)


def _sensor_elements(
    scene: Scene, group: SceneSensor, followed: Array, rng: np.random.Generator
) -> Array:
    if not (group.in_view and group.pointing.mode == "track"):
        return _elements(group.orbit, rng)
    t_s = np.linspace(0, scene.duration_s, 2 + int(scene.duration_s / 60))
    r_followed, _ = state_at(followed, t_s)
    for _ in range(_DRAWS):
        elements = _elements(group.orbit, rng)
        r_km, _ = state_at(elements, t_s)
        d = r_followed - r_km
        distance = np.linalg.norm(d, axis=1)
        if not hidden_by_earth(r_km, d / distance[:, None], distance).any():
            return elements
    raise SceneError(
        f"{scene.name}: sensor {group.id}: no random orbit keeps the tracked object in view"
    )

"""Draw the sensors of a scene: orbits, pointing, optics, noise and faults."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array
from epipole.schemas.errors import SceneError
from epipole.schemas.scene import Scene, SceneCamera, SceneSensor
from epipole.schemas.star_lists import ElementSet
from epipole.tasks.algorithms.simulation.constants import ARCSEC
from epipole.tasks.algorithms.simulation.element_sets import directions_to_sun
from epipole.tasks.algorithms.simulation.exposures import SATELLITE_RADIUS_KM
from epipole.tasks.algorithms.simulation.optics import TrueOptics, hidden_by_earth
from epipole.tasks.algorithms.simulation.paths import Paths, resting_path, two_body_paths
from epipole.tasks.algorithms.simulation.sensor import (
    SimulatedSensor,
    azimuth_away,
    random_stream,
)
from epipole.tasks.simulate.draw_objects import (
    NO_SENSOR,
    DrawnObjects,
    Satellites,
    constellation,
    draw_elements,
    propagate_satellites,
)

# Optics: as the log reports them, and the true ones.


def sent_optics(camera: SceneCamera) -> TrueOptics:
    """Return the optics that the log reports."""
    if camera.focal_px is not None:
        focal = camera.focal_px
    else:
        half_rad = math.radians(camera.fov_deg or 0.0) / 2
        focal = camera.width / 2 / (half_rad if camera.fisheye else math.tan(half_rad))
    cx = (camera.width - 1) / 2 if camera.cx_px is None else camera.cx_px
    cy = (camera.height - 1) / 2 if camera.cy_px is None else camera.cy_px
    lens = camera.k1, camera.k2, camera.p1, camera.p2, camera.k3, camera.k4, camera.fisheye
    return TrueOptics(
        camera.width, camera.height, focal, focal, cx, cy, *lens, line_time_s=camera.line_time_s
    )


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


# Sensors.


_DRAWS = 10_000  # maximum number, to find a random orbit from which the tracked object is visible


class DrawnSensor(NamedTuple):
    """A sensor, its group in the scene, and the element set that it moves by, if any."""

    sensor: SimulatedSensor
    group: SceneSensor
    element_set: ElementSet | None
    satellite: str  # its name, the same for all sensors on it


def draw_sensors(scene: Scene, t0_ns: int, objects: DrawnObjects) -> list[DrawnSensor]:
    """Return the sensors of all groups of a scene, in its order."""
    drawn: list[DrawnSensor] = []
    for group in scene.sensors:
        if group.orbit.shells:
            drawn += _on_constellation(scene, group, t0_ns, objects, len(drawn))
        elif group.orbit.elements is None:
            drawn += _near_orbits(scene, group, t0_ns, objects, len(drawn))
        else:
            drawn += _on_satellites(scene, group, t0_ns, objects, len(drawn))
    for each in drawn:
        _require_apart(scene, each.sensor)
    return drawn


def _require_apart(scene: Scene, sensor: SimulatedSensor) -> None:
    """Raise where a sensor tracks the satellite that carries it."""
    if sensor.followed is None:
        return
    start = np.zeros(1)
    apart_km = np.linalg.norm(sensor.followed.at(start)[0] - sensor.path.at(start)[0])
    if apart_km < SATELLITE_RADIUS_KM:
        raise SceneError(
            f"{scene.name}: sensor {sensor.sensor_id} tracks the satellite that carries it"
        )


def _near_orbits(
    scene: Scene, group: SceneSensor, t0_ns: int, objects: DrawnObjects, first: int
) -> Iterator[DrawnSensor]:
    """Yield the sensors of a group whose orbits are two-body ones."""
    count = group.count or 1
    for k in range(count):
        name = group.id if count == 1 else f"{group.id}{k + 1}"
        rng = random_stream(scene.seed, first + k, "sensor")
        phase = _phase(group, rng)
        followed = _followed(scene, group, t0_ns, objects, rng)
        path = _two_body_path(scene, group, followed, rng)
        made = _sensor(scene, group, name, first + k, t0_ns, phase, path, followed)
        yield DrawnSensor(made, group, None, name)


def _on_constellation(
    scene: Scene, group: SceneSensor, t0_ns: int, objects: DrawnObjects, first: int
) -> Iterator[DrawnSensor]:
    """Yield the sensors of a group, one on each satellite of a constellation."""
    satellites = constellation(scene, group.orbit, group.count, t0_ns)
    for k, element_set in enumerate(satellites.sets):
        rng = random_stream(scene.seed, first + k, "sensor")
        phase = _phase(group, rng)
        followed = _followed(scene, group, t0_ns, objects, rng)
        path = satellites.paths.of(k)
        name = f"{element_set.name}{group.id}"
        made = _sensor(scene, group, name, first + k, t0_ns, phase, path, followed)
        if random_stream(scene.seed, NO_SENSOR + k, "priors").random() >= group.states.prior_share:
            made = replace(made, prior_noise=None)
        yield DrawnSensor(made, group, element_set, element_set.name)


def _on_satellites(
    scene: Scene, group: SceneSensor, t0_ns: int, objects: DrawnObjects, first: int
) -> Iterator[DrawnSensor]:
    """Yield the sensors of a group, each on another satellite of a list of element sets.

    Where the tracked object has to be visible (`in_view`), satellites from which it is not are
    passed over.
    """
    satellites = propagate_satellites(scene, group.orbit, t0_ns)
    order = np.arange(len(satellites.sets))
    if group.count is not None and group.count < len(order):
        order = random_stream(scene.seed, first, "satellites").permutation(order)
    taken = 0
    for row in order.tolist():
        rng = random_stream(scene.seed, first + taken, "sensor")
        phase = _phase(group, rng)
        followed = _followed(scene, group, t0_ns, objects, rng)
        path = satellites.paths.of(row)
        if group.in_view and followed is not None and not _sees(scene, path, followed):
            continue
        taken += 1
        name = group.id if group.count == 1 or len(order) == 1 else f"{group.id}{taken}"
        made = _sensor(scene, group, name, first + taken - 1, t0_ns, phase, path, followed)
        yield DrawnSensor(made, group, satellites.sets[row], name)
        if taken == group.count:
            return
    if not taken or group.count is not None:
        raise SceneError(_too_few(scene, group, satellites, taken))


def _too_few(scene: Scene, group: SceneSensor, satellites: Satellites, found: int) -> str:
    view = ", from which the tracked object is always visible" if group.in_view else ""
    return (
        f"{scene.name}: sensor {group.id}: {group.count or 1} satellites are wanted of "
        f"{len(satellites.sets)} in {group.orbit.elements}{view}; found {found}"
    )


def _phase(group: SceneSensor, rng: np.random.Generator) -> float:
    """Return when in the frame interval frames are taken, as a share of it: given, or random."""
    return float(rng.random()) if group.phase is None else group.phase


def _followed(
    scene: Scene, group: SceneSensor, t0_ns: int, objects: DrawnObjects, rng: np.random.Generator
) -> Paths | None:
    """Return the path of what the sensor tracks, None where it tracks nothing."""
    pointing = group.pointing
    if pointing.mode != "track":
        return None
    if pointing.place_km is not None:
        return resting_path(np.array(pointing.place_km))
    if isinstance(pointing.target, str):
        return objects.objects.paths.of(objects.number_of(pointing.target, scene))
    if pointing.target is not None:
        if pointing.target >= len(objects.sets):
            raise SceneError(
                f"{scene.name}: sensor {group.id} tracks target {pointing.target} of "
                f"{len(objects.sets)}"
            )
        return objects.objects.paths.of(pointing.target)
    if pointing.orbit is not None and pointing.orbit.elements is not None:
        found = propagate_satellites(scene, pointing.orbit, t0_ns)
        if len(found.sets) > 1:
            raise SceneError(
                f"{scene.name}: sensor {group.id} tracks {len(found.sets)} satellites of "
                f"{pointing.orbit.elements}; name one in satellites"
            )
        return found.paths
    return two_body_paths(draw_elements(pointing.orbit, rng)) if pointing.orbit else None


def _two_body_path(
    scene: Scene, group: SceneSensor, followed: Paths | None, rng: np.random.Generator
) -> Paths:
    if not group.in_view or followed is None:
        return two_body_paths(draw_elements(group.orbit, rng))
    for _ in range(_DRAWS):
        path = two_body_paths(draw_elements(group.orbit, rng))
        if _sees(scene, path, followed):
            return path
    raise SceneError(
        f"{scene.name}: sensor {group.id}: no random orbit keeps the tracked object in view"
    )


def _sees(scene: Scene, path: Paths, followed: Paths) -> bool:
    """Return whether the Earth is never between a sensor and what it tracks.

    A sensor does not see the satellite that carries it.
    """
    t_s = np.linspace(0, scene.duration_s, 2 + int(scene.duration_s / 60))
    r_km, _ = path.at(t_s)
    d = followed.at(t_s)[0] - r_km
    distance = np.linalg.norm(d, axis=1)
    if distance.min() < SATELLITE_RADIUS_KM:
        return False
    return not hidden_by_earth(r_km, d / distance[:, None], distance).any()


def _sensor(
    scene: Scene,
    group: SceneSensor,
    name: str,
    index: int,
    t0_ns: int,
    phase: float,
    path: Paths,
    followed: Paths | None,
) -> SimulatedSensor:
    pointing, detection, states, faults = (
        group.pointing, group.detection, group.states, group.faults
    )  # fmt: skip
    limit = group.magnitude_limit
    streams = partial(random_stream, scene.seed, index)
    ra, dec = math.radians(pointing.ra_deg or 0.0), math.radians(pointing.dec_deg or 0.0)
    noise_arcsec = states.prior_noise_arcsec
    azimuth, elevation = _mounting(group, path, t0_ns, streams("mounting"))
    return SimulatedSensor(
        sensor_id=name,
        index=index,
        seed=scene.seed,
        t0_ns=t0_ns,
        duration_s=scene.duration_s,
        path=path,
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
        azimuth=azimuth,
        elevation=elevation,
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
        magnitude_limit=limit,
        object_limit=limit if group.object_limit is None else group.object_limit,
        fade=detection.fade,
        sigma_px=detection.sigma_px,
        faint_sigma_px=detection.faint_sigma_px,
        flux_error=detection.flux_error,
        false_points=detection.false_points,
        hot_pixels=detection.hot_pixels,
        star_drop=detection.star_drop,
        target_drop=detection.target_drop,
        blend_px=detection.blend_px,
        trail_error=detection.trail_error,
        state_rate_hz=states.rate_hz,
        state_margin_s=states.margin_s,
        position_noise_km=states.position_noise_km,
        position_bias_km=states.position_bias_km,
        prior_noise=None if noise_arcsec is None else noise_arcsec * ARCSEC,
        prior_bias=states.prior_bias_arcsec * ARCSEC,
        position_offset_km=_offset(faults.position_offset_km, streams, "position fault"),
        position_told=faults.position_told,
        prior_offset=_offset(faults.prior_offset_arcsec, streams, "attitude fault") * ARCSEC,
        prior_told=faults.prior_told,
    )


def _mounting(
    group: SceneSensor, path: Paths, t0_ns: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Return azimuth and elevation of a boresight that is fixed to the body [rad]."""
    pointing = group.pointing
    turn = np.radians(pointing.spread_deg) * rng.uniform(-1.0, 1.0, 2)
    azimuth = math.radians(pointing.azimuth_deg) + float(turn[0])
    elevation = math.radians(pointing.elevation_deg) + float(turn[1])
    if pointing.azimuth_from == "anti_sun":
        r_km, v_km_s = path.at(np.zeros(1))
        azimuth += azimuth_away(r_km[0], v_km_s[0], directions_to_sun(np.array([t0_ns]))[0])
    return azimuth, elevation


def _offset(
    offset: float | tuple[float, float, float],
    streams: Callable[[str], np.random.Generator],
    purpose: str,
) -> Array:
    """Return an offset (3,): as given, or of the given length in a random direction."""
    if isinstance(offset, tuple):
        return np.array(offset, float)
    direction = streams(purpose).standard_normal(3)
    return offset * direction / np.linalg.norm(direction)


def _radians(degrees: float | None) -> float | None:
    return None if degrees is None else math.radians(degrees)

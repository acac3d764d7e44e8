"""Simulate a scene: its sensors and objects, and block by block what the sensors see.

These are plain functions, not Prefect tasks, because a simulation is not scheduled and streams its
results.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from epipole.io.simulation.sky import SkyStars, read_stars
from epipole.schemas.bridge import table, unstack
from epipole.schemas.errors import SceneError
from epipole.schemas.scene import Scene, SceneSensor
from epipole.schemas.star_lists import ElementSet
from epipole.schemas.work_tables import TRUE_FRAMES, TRUE_ORBITS, TRUE_POINTS
from epipole.tasks.algorithms.simulation.constants import SECOND_NS
from epipole.tasks.algorithms.simulation.exposures import BLEND_DEPTH, Exposing, Exposures
from epipole.tasks.algorithms.simulation.optics import field_radius
from epipole.tasks.algorithms.simulation.paths import END_NODES
from epipole.tasks.algorithms.simulation.sensor import SimulatedSensor, frame_times
from epipole.tasks.algorithms.simulation.sources import (
    SimulatedObjects,
    StarField,
    may_be_detected,
    star_field,
)
from epipole.tasks.simulate.draw_objects import draw_objects, scene_nodes
from epipole.tasks.simulate.draw_sensors import DrawnSensor, draw_sensors

FRAMES_AT_ONCE = 4096


@dataclass(frozen=True)
class Simulation:
    """A scene whose random choices have been made."""

    scene: Scene
    t0_ns: int
    sensors: list[SimulatedSensor]
    sensor_sets: list[ElementSet | None]  # what each sensor moves by, where it is an element set
    groups: list[SceneSensor]  # the group of the scene that each sensor belongs to
    satellites: list[str]  # on which each sensor is
    objects: SimulatedObjects
    object_sets: list[ElementSet | None]


def simulate_scene(scene: Scene) -> Simulation:
    """Return the sensors and objects of a scene. The same scene always gives the same ones."""
    t0_ns = round(scene.start.timestamp() * 1e6) * 1000
    drawn = draw_objects(scene, t0_ns)
    sensors = draw_sensors(scene, t0_ns, drawn)
    names = [s.sensor.sensor_id for s in sensors]
    if len(set(names)) < len(names):
        twice = next(name for name in names if names.count(name) > 1)
        raise SceneError(f"{scene.name}: two sensors would be called {twice}")
    _require_one_path(scene, sensors)
    return Simulation(
        scene,
        t0_ns,
        [s.sensor for s in sensors],
        [s.element_set for s in sensors],
        [s.group for s in sensors],
        [s.satellite for s in sensors],
        drawn.objects,
        drawn.sets,
    )


def _require_one_path(scene: Scene, sensors: list[DrawnSensor]) -> None:
    """Raise where two satellites of constellations would have the same name."""
    sets: dict[str, ElementSet | None] = {}
    for drawn in sensors:
        if sets.setdefault(drawn.satellite, drawn.element_set) != drawn.element_set:
            raise SceneError(
                f"{scene.name}: two satellites would be called {drawn.satellite}; give all sensors "
                "with shells the same orbit and count"
            )


class SceneSky:
    """The stars of a scene, prepared once for all sensors with the same optics and limit."""

    def __init__(self, simulation: Simulation) -> None:
        faintest = max(_faintest(s) for s in simulation.sensors)
        self._stars = read_stars(simulation.scene.catalogue, faintest)
        self._fields: dict[tuple[float, ...], StarField] = {}

    def field(self, sensor: SimulatedSensor) -> StarField:
        """Return the stars that the sensor may detect."""
        focal_px = min(sensor.optics.fx_px, sensor.optics.fy_px)
        key = sensor.magnitude_limit, field_radius(sensor.optics), sensor.blend_px / focal_px
        if key not in self._fields:
            self._fields[key] = _field(self._stars, *key)
        return self._fields[key]


def _faintest(sensor: SimulatedSensor) -> float:
    return sensor.magnitude_limit + (BLEND_DEPTH if sensor.blend_px else 0.0)


def expose_blocks(
    simulation: Simulation, members: Sequence[int] | None = None, sky: SceneSky | None = None
) -> Iterator[list[Exposures]]:
    """Yield what each sensor sees, in blocks of time that limit the memory.

    Parameters
    ----------
    members : sequence of int
        The sensors. Default: all. What one sees does not depend on the others.
    sky : SceneSky
        The stars of the simulation, to share them between calls.
    """
    chosen = range(len(simulation.sensors)) if members is None else members
    sensors = [simulation.sensors[k] for k in chosen]
    sky = SceneSky(simulation) if sky is None else sky
    work = []
    for sensor in sensors:
        exposing = Exposing(sensor, sky.field(sensor), simulation.objects)
        work.append((exposing, *frame_times(sensor)))
    rate = sum(s.rate_hz for s in sensors)
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
            "magnitude": exposed.magnitude,
            "also": pa.array(exposed.also, pa.int64(), mask=exposed.also < 0),
        },
    )
    return frames, points


def true_orbits(simulation: Simulation) -> pa.Table | None:
    """Return the truth of the objects at even times: TRUE_ORBITS; None where all have elements."""
    paths = simulation.objects.paths
    if not paths.is_sampled.any():
        return None
    t_s = scene_nodes(simulation.scene)[END_NODES:-END_NODES]
    t_ns = simulation.t0_ns + np.rint(t_s * SECOND_NS).astype(np.int64)
    number = np.repeat(np.arange(len(paths)), len(t_s))
    r_km, v_km_s = paths.at(np.tile(t_s, len(paths)), number)
    return table(
        TRUE_ORBITS,
        {
            "object": number,
            "t_ns": np.tile(t_ns, len(paths)),
            **unstack("{}", r_km),
            **unstack("v{}", v_km_s),
        },
    )


def _field(
    stars: SkyStars, magnitude_limit: float, radius_rad: float, blend_rad: float
) -> StarField:
    bright = stars.magnitude <= magnitude_limit
    if blend_rad:
        deep = stars.magnitude <= magnitude_limit + BLEND_DEPTH
        cos_dec = np.cos(stars.dec)
        u = [cos_dec * np.cos(stars.ra), cos_dec * np.sin(stars.ra), np.sin(stars.dec)]
        # A lens stretches by a few per cent at most, proper motion by some arcseconds.
        apart_rad = 1.2 * blend_rad + 3e-4
        found = may_be_detected(
            np.stack(u, axis=1)[deep], stars.magnitude[deep], magnitude_limit, apart_rad
        )
        bright = deep.copy()
        bright[deep] = found
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

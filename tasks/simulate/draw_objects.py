"""Draw the objects of a scene: orbits, real satellites, and how bright they are."""

import difflib
import math
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from epipole.io.simulation.scenes import read_element_sets
from epipole.schemas.arrays import Array
from epipole.schemas.errors import SceneError
from epipole.schemas.scene import Orbit, Scene, SceneTargets
from epipole.schemas.star_lists import ElementSet, nearest_sets
from epipole.tasks.algorithms.simulation.constants import (
    DAY_S,
    EARTH_RADIUS_KM,
    GM_KM3_S2,
    SECOND_NS,
)
from epipole.tasks.algorithms.simulation.element_sets import propagate
from epipole.tasks.algorithms.simulation.paths import (
    Paths,
    circular_velocity,
    elements_from_state,
    joined_paths,
    mean_from_true_anomaly,
    node_times,
    sampled_paths,
    state_at,
    two_body_paths,
)
from epipole.tasks.algorithms.simulation.sensor import random_stream
from epipole.tasks.algorithms.simulation.shells import (
    mean_elements,
    nearest_of,
    random_population,
    scattered,
    walker_elements,
)
from epipole.tasks.algorithms.simulation.sources import SimulatedObjects

# Orbits: elements, positions, random ones, and objects near them.


RADIAL = 1e-6  # [km/s] a velocity with a smaller part across falls to the centre of the Earth
NO_SENSOR = 1_000_000  # first index of the random streams that belong to no sensor


def draw_elements(orbit: Orbit, rng: np.random.Generator) -> Array:
    """Return the (6,) elements of an orbit. Only a random orbit draws from `rng`."""
    if orbit.random is not None:
        return _random_elements(orbit.random, rng)
    if orbit.position_km is not None:
        r_km = np.array(orbit.position_km)
        v = orbit.velocity_km_s
        v_km_s = circular_velocity(r_km) if v is None else np.array(v)
        if v_km_s @ v_km_s >= 2 * GM_KM3_S2 / np.linalg.norm(r_km):
            raise SceneError(f"velocity_km_s {v}: faster than escape velocity")
        if np.linalg.norm(np.cross(r_km, v_km_s)) < RADIAL * np.linalg.norm(r_km):
            raise SceneError(f"velocity_km_s {v}: straight up or down; an orbit goes across too")
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


def draw_near(orbit: Orbit, spread_km: float, rng: np.random.Generator) -> Array:
    """Return the (6,) elements of a body about the position of an orbit at the start."""
    elements = draw_elements(orbit, rng)
    if not spread_km:
        return elements
    r_km, v_km_s = state_at(elements, np.zeros(()))
    moved = r_km + rng.standard_normal(3) * spread_km
    # The same direction of motion, but horizontal and circular at the new position.
    level = v_km_s - moved * (v_km_s @ moved) / (moved @ moved)
    speed = np.linalg.norm(circular_velocity(moved))
    return elements_from_state(moved, level / np.linalg.norm(level) * speed)


# Real satellites: element sets from a file, propagated over the scene.

# [s] Light time, and the half interval that a random pointing begins early.
_ROOM_S = 10.0


class Satellites(NamedTuple):
    """Element sets, and the paths that SGP4 makes of them."""

    sets: list[ElementSet]
    paths: Paths


def propagate_satellites(scene: Scene, orbit: Orbit, t0_ns: int) -> Satellites:
    """Return the satellites of an orbit with `elements`, over the whole scene.

    Raises
    ------
    SceneError
        Where the file lacks the satellites, their elements are too old or too new, or SGP4
        fails. It names the satellite.
    """
    if orbit.elements is None:
        raise SceneError(f"{scene.name}: an orbit without elements has no satellites")
    middle_ns = t0_ns + round(scene.duration_s / 2 * SECOND_NS)
    sets = nearest_sets(_chosen(read_element_sets(orbit.elements), orbit), middle_ns)
    if orbit.usable_only:
        sets = [each for each in sets if _days_from(each, middle_ns) <= scene.element_age_days]
        if not sets:
            raise SceneError(f"{orbit.elements}: no elements near the scene's {_text(t0_ns)}")
    for element_set in sets:
        _require_near(element_set, middle_ns, scene, orbit.elements)
    return _propagated(scene, sets, t0_ns, orbit.elements, orbit.usable_only)


def _propagated(
    scene: Scene, sets: list[ElementSet], t0_ns: int, where: str, usable_only: bool = False
) -> Satellites:
    """Return the satellites of element sets with their paths; `where` names them in messages."""
    t_s = scene_nodes(scene)
    time_ns = t0_ns + np.rint(t_s * SECOND_NS).astype(np.int64)
    elements = np.array([element_set.elements for element_set in sets]).reshape(len(sets), 10)
    r_km, failures = propagate(elements, time_ns)
    if failures and usable_only:
        failed = {failure.satellite for failure in failures}
        kept = [k for k in range(len(sets)) if k not in failed]
        return Satellites([sets[k] for k in kept], sampled_paths(t_s, r_km[kept]))
    if failures:
        first = failures[0]
        raise SceneError(
            f"{where}: {sets[first.satellite].label}: SGP4 fails at "
            f"{_text(first.time_ns)}: {first.reason}; leave this satellite out"
        )
    return Satellites(sets, sampled_paths(t_s, r_km))


def constellation(scene: Scene, orbit: Orbit, count: int | None, t0_ns: int) -> Satellites:
    """Return the satellites of the shells of an orbit, or `count` of them.

    They depend on the scene's seed, the shells and the count only: several groups of sensors and
    of objects are on the same satellites.

    Raises
    ------
    SceneError
        Where the shells have fewer satellites.
    """
    rng = random_stream(scene.seed, NO_SENSOR, "constellation")
    patterns = []
    for shell in orbit.shells:
        i_deg, t, p, f = shell.pattern
        a_km, arc = EARTH_RADIUS_KM + shell.altitude_km, math.radians(shell.arc_deg)
        patterns.append(walker_elements(a_km, math.radians(i_deg), (t, p, f), arc))
    elements = scattered(np.concatenate(patterns), orbit.scatter_km, rng)
    total, count = len(elements), len(elements) if count is None else count
    if count > total:
        raise SceneError(f"{scene.name}: {count} satellites are wanted of {total} in the shells")
    mean = mean_elements(elements, t0_ns)
    if orbit.near and count < total:
        middle = np.array([t0_ns + round(scene.duration_s / 2 * SECOND_NS)])
        centre = int(rng.integers(total))
        chosen = nearest_of(propagate(mean, middle)[0][:, 0], centre, count)
    else:
        chosen = np.sort(rng.permutation(total)[:count])
    digits = max(3, len(str(count)))
    names = [f"s{k + 1:0{digits}d}" for k in range(count)]
    return _propagated(scene, _made_sets(names, mean[chosen], t0_ns), t0_ns, scene.name)


def _made_sets(names: list[str], mean: Array, t0_ns: int) -> list[ElementSet]:
    """Return element sets of satellites that are in no catalogue: their number is 0."""
    rows = zip(names, mean.tolist(), strict=True)
    return [ElementSet(name, 0, t0_ns, tuple(row)) for name, row in rows]


def draw_satellites(
    satellites: Satellites, count: int | None, rng: np.random.Generator
) -> Satellites:
    """Return `count` of the satellites at random, in their order; all for None."""
    n = len(satellites.sets)
    if count is None or count == n:
        return satellites
    if count > n:
        raise SceneError(f"{count} satellites are wanted of {n} in the file")
    taken = np.sort(rng.permutation(n)[:count])
    return Satellites([satellites.sets[i] for i in taken], satellites.paths.of(*taken))


def scene_nodes(scene: Scene) -> np.ndarray:
    """Return the times of nodes that cover a scene and the states about it [s]."""
    margin = max(sensor.states.margin_s for sensor in scene.sensors)
    hold = max(sensor.pointing.hold_s or 1 / sensor.rate_hz for sensor in scene.sensors)
    return node_times(
        -max(margin, hold) - _ROOM_S, scene.duration_s + max(margin, 2 * hold) + _ROOM_S
    )


def _chosen(sets: list[ElementSet], orbit: Orbit) -> list[ElementSet]:
    """Return the sets of the satellites that an orbit names, in the order of the names."""
    if not orbit.satellites:
        return sets
    chosen: list[ElementSet] = []
    for wanted in orbit.satellites:
        found = [s for s in sets if s.is_called(str(wanted))]
        if not found:
            names = [s.name for s in sets]
            key = str(wanted).strip().upper()
            close = difflib.get_close_matches(key, names, n=3, cutoff=0.5)
            hint = f"; it has {', '.join(close)}" if close else ""
            raise SceneError(f"{orbit.elements}: has no satellite {wanted}{hint}")
        chosen += [s for s in found if s not in chosen]
    return chosen


def _require_near(element_set: ElementSet, time_ns: int, scene: Scene, file: str) -> None:
    days = _days_from(element_set, time_ns)
    if days > scene.element_age_days:
        raise SceneError(
            f"{file}: {element_set.label}: its elements are of {_text(element_set.epoch_ns)}, "
            f"{days:.0f} days from the scene; give others, another start, or a larger "
            f"element_age_days than {scene.element_age_days:g}"
        )


def _days_from(element_set: ElementSet, time_ns: int) -> float:
    return abs(element_set.epoch_ns - time_ns) / SECOND_NS / DAY_S


def _text(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns // SECOND_NS, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


# Objects.


class DrawnObjects(NamedTuple):
    """The objects, and what each moves by, where it is an element set."""

    objects: SimulatedObjects
    sets: list[ElementSet | None]

    def number_of(self, name: str, scene: Scene) -> int:
        """Return the number of the object of this name or catalogue number."""
        for number, element_set in enumerate(self.sets):
            if element_set and element_set.is_called(name):
                return number
        raise SceneError(f"{scene.name}: no object is called {name}")


def draw_objects(scene: Scene, t0_ns: int) -> DrawnObjects:
    """Return the objects of all groups of a scene, in its order."""
    paths: list[Paths] = []
    sets: list[ElementSet | None] = []
    magnitudes, standard = [np.empty(0)], [np.empty(0, bool)]
    for k, group in enumerate(scene.targets):
        rng = random_stream(scene.seed, NO_SENSOR + k, "targets")
        group_paths, group_sets = _drawn(scene, group, t0_ns, rng)
        paths.append(group_paths)
        sets += group_sets
        is_standard = group.standard_magnitude is not None
        limits = group.standard_magnitude if is_standard else group.magnitude
        low, high = np.broadcast_to(np.asarray(limits, float), 2)
        magnitudes.append(low + (high - low) * rng.random(len(group_sets)))
        standard.append(np.full(len(group_sets), is_standard))
    objects = SimulatedObjects(
        joined_paths(paths),
        np.concatenate(magnitudes),
        np.concatenate(standard),
        scene.earth_shadow,
        scene.phase_law,
    )
    return DrawnObjects(objects, sets)


def _drawn(
    scene: Scene, group: SceneTargets, t0_ns: int, rng: np.random.Generator
) -> tuple[Paths, list[ElementSet | None]]:
    if group.orbit.elements is not None:
        found = draw_satellites(propagate_satellites(scene, group.orbit, t0_ns), group.count, rng)
        return found.paths, list(found.sets)
    if group.orbit.shells:
        found = constellation(scene, group.orbit, group.count, t0_ns)
        return found.paths, list(found.sets)
    count = 1 if group.count is None else group.count
    if group.orbit.random == "low":
        mean = mean_elements(random_population(count, rng), t0_ns)
        names = [f"o{k + 1:05d}" for k in range(count)]
        found = _propagated(scene, _made_sets(names, mean, t0_ns), t0_ns, scene.name)
        return found.paths, list(found.sets)
    made = [draw_near(group.orbit, group.spread_km, rng) for _ in range(count)]
    return two_body_paths(np.array(made)), [None] * count

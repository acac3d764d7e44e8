"""Place real satellites: choose element sets from a file, and propagate them over the scene."""

import difflib
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from epipole.io.simulation.element_files import read_element_sets
from epipole.schemas.catalogues.element_set import ElementSet, nearest_sets
from epipole.schemas.errors import SceneError
from epipole.schemas.simulation.orbit import Orbit
from epipole.schemas.simulation.scene import Scene
from epipole.tasks.algorithms.simulation.constants import DAY_S, SECOND_NS
from epipole.tasks.algorithms.simulation.element_sets.propagation import propagate
from epipole.tasks.algorithms.simulation.paths import Paths, node_times, sampled_paths

# [s] Light time, and the half interval that a random pointing begins early.
_ROOM_S = 10.0


class Satellites(NamedTuple):
    """Element sets, and the paths that SGP4 makes of them."""

    sets: list[ElementSet]
    paths: Paths


def place_satellites(scene: Scene, orbit: Orbit, t0_ns: int) -> Satellites:
    """Return the satellites of an orbit with `elements`, over the whole scene.

    Raises
    ------
    SceneError
        Where the file has none of the satellites, their elements are too old or too new, or SGP4
        fails. It names the satellite.
    """
    if orbit.elements is None:
        raise SceneError(f"{scene.name}: an orbit without elements has no satellites")
    middle_ns = t0_ns + round(scene.duration_s / 2 * SECOND_NS)
    sets = nearest_sets(_chosen(read_element_sets(orbit.elements), orbit), middle_ns)
    for element_set in sets:
        _require_near(element_set, middle_ns, scene, orbit.elements)
    t_s = scene_nodes(scene)
    time_ns = t0_ns + np.rint(t_s * SECOND_NS).astype(np.int64)
    elements = np.array([element_set.elements for element_set in sets])
    r_km, failures = propagate(elements, time_ns)
    if failures:
        first = failures[0]
        raise SceneError(
            f"{orbit.elements}: {sets[first.satellite].label}: SGP4 fails at "
            f"{_text(first.time_ns)}: {first.reason}; leave this satellite out"
        )
    return Satellites(sets, sampled_paths(t_s, r_km))


def draw_satellites(
    satellites: Satellites, count: int | None, rng: np.random.Generator
) -> Satellites:
    """Return `count` of the satellites at random, in their order; all where it is None."""
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
    days = abs(element_set.epoch_ns - time_ns) / SECOND_NS / DAY_S
    if days > scene.element_age_days:
        raise SceneError(
            f"{file}: {element_set.label}: its elements are of {_text(element_set.epoch_ns)}, "
            f"{days:.0f} days from the scene; give others, another start, or a larger "
            f"element_age_days than {scene.element_age_days:g}"
        )


def _text(time_ns: int) -> str:
    return datetime.fromtimestamp(time_ns // SECOND_NS, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")

"""Draw the objects of a scene: their paths and how bright they are."""

from typing import NamedTuple

import numpy as np

from epipole.schemas.catalogues.element_set import ElementSet
from epipole.schemas.errors import SceneError
from epipole.schemas.simulation.scene import Scene, SceneTargets
from epipole.tasks.algorithms.simulation.objects import SimulatedObjects
from epipole.tasks.algorithms.simulation.paths import Paths, joined_paths, two_body_paths
from epipole.tasks.algorithms.simulation.sensor import random_stream
from epipole.tasks.simulate.draw_orbits import draw_near
from epipole.tasks.simulate.place_satellites import draw_satellites, place_satellites

NO_SENSOR = 1_000_000  # first index of the random streams that belong to no sensor


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
        found = draw_satellites(place_satellites(scene, group.orbit, t0_ns), group.count, rng)
        return found.paths, list(found.sets)
    count = 1 if group.count is None else group.count
    made = [draw_near(group.orbit, group.spread_km, rng) for _ in range(count)]
    return two_body_paths(np.array(made)), [None] * count

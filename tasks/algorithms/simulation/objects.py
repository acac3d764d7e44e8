"""The objects of a scene: where they are, and how bright they seem."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.simulation.brightness import (
    in_earth_shadow,
    lambert_dimming,
    magnitude_at,
)
from epipole.tasks.algorithms.simulation.paths import Paths

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


@dataclass(frozen=True)
class SimulatedObjects:
    """The paths of n objects, their brightness, and what the Sun does to it."""

    paths: Paths
    magnitude: Array  # (n,)
    is_standard: npt.NDArray[np.bool_]  # (n,) magnitude at 1000 km, else the same everywhere
    earth_shadow: bool = False
    phase_law: bool = False

    def __len__(self) -> int:
        return len(self.paths)

    @property
    def need_sun(self) -> bool:
        """Return whether magnitudes depend on where the Sun is."""
        return self.earth_shadow or self.phase_law

    def magnitudes(self, body: Indices, d_km: Array, r_km: Array, u_to_sun: Array) -> Array:
        """Return the apparent magnitudes of objects; infinite where no light comes from them.

        Parameters
        ----------
        body : (n,) int
            Index of the object.
        d_km, r_km : (n, 3) float
            The object from the sensor, and from the Earth's centre.
        u_to_sun : (n, 3) float
            Unit vectors from the Earth to the Sun; not read unless `need_sun`.
        """
        magnitude = self.magnitude[body]
        distance_km = np.linalg.norm(d_km, axis=1)
        standard = self.is_standard[body]
        magnitude[standard] = magnitude_at(magnitude[standard], distance_km[standard])
        if self.phase_law:
            magnitude = magnitude + lambert_dimming(u_to_sun, d_km / distance_km[:, None])
        if self.earth_shadow:
            magnitude = np.where(in_earth_shadow(r_km, u_to_sun), np.inf, magnitude)
        return magnitude

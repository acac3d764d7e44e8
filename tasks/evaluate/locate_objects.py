"""Locate true objects: their positions and velocities at given times."""

import numpy as np
import pyarrow as pa

from epipole.io.simulation.truth import Truth, elements_of
from epipole.schemas.bridge import array, stack
from epipole.tasks.algorithms.evaluation import SampledOrbits, interpolate_orbits
from epipole.tasks.algorithms.simulation.orbits import state_at
from epipole.tasks.evaluate.match_points import Array, Indices


def locate_objects(truth: Truth, objects: Indices, time_ns: Indices) -> tuple[Array, Array]:
    """Return the position and velocity of a true object at a time, for each row.

    Objects move by the sampled orbits of the truth where it has them, else by their elements.

    Parameters
    ----------
    objects : (n,) int
        Numbers of true objects, 0 or more.
    time_ns : (n,) int
        UTC since 1970 [ns].

    Returns
    -------
    r_km, v_km_s : (n, 3) float
        GCRF [km and km/s].
    """
    t0_ns = int(truth.scenario["t0_ns"])
    t_s = (time_ns - t0_ns) / 1e9
    if truth.orbits is None:
        return state_at(elements_of(truth)[objects], t_s)
    return interpolate_orbits(_sampled(truth.orbits, t0_ns), objects, t_s)


def _sampled(orbits: pa.Table, t0_ns: int) -> SampledOrbits:
    number, time_ns = array(orbits, "object"), array(orbits, "t_ns")
    order = np.lexsort((time_ns, number))
    return SampledOrbits(
        object=number[order],
        t_s=(time_ns[order] - t0_ns) / 1e9,
        r_km=stack(orbits, "{}")[order],
        v_km_s=stack(orbits, "v{}")[order],
    )

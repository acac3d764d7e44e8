"""Orbits of objects: the observations of each as directions, and the orbit that fits them best."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import polars as pl
from scipy.special import chdtrc

from epipole.schemas.arrays import Array, Integers
from epipole.schemas.columns import POSITION
from epipole.schemas.rejects import Reason
from epipole.schemas.work_tables import SHARED_OBSERVATIONS
from epipole.tasks.algorithms.constants import (
    ARCSEC,
    SECOND_NS,
)
from epipole.tasks.algorithms.geometry.directions import east_north, unit_from_radec
from epipole.tasks.algorithms.orbit_linking.population import log_density
from epipole.tasks.algorithms.orbits.forces import Surroundings
from epipole.tasks.algorithms.orbits.initial_orbit import LONGER_S, LONGEST_S, initial_orbit
from epipole.tasks.algorithms.orbits.orbit_determination import (
    AreaPrior,
    DeterminedOrbit,
    ObjectDirections,
    determine_orbit,
    log_evidence,
    neglected,
)
from epipole.tasks.algorithms.orbits.platforms import platform_sizes
from epipole.tasks.algorithms.orbits.reference_frames import state_rotation
from epipole.tasks.common.grouping import factorize, group_offsets
from epipole.tasks.common.orbit_forces import (
    AIR_AREA,
    DRAG,
    GRAVITY,
    RADIATION,
    SUNLIT_AREA,
    is_sunlit,
)
from epipole.tasks.publish.sensor_errors import SensorSums, summed_equations

MIN_PROBABILITY = 1e-6  # of a chi-square: an orbit with a less probable one is rejected
# 1-sigma of stated variances: they are right to a per cent or two. Without it chi-square would ask
# for half a per cent of a million directions: an object that four sensors followed for twelve hours
# had 1.023 per degree of freedom, and was rejected.
VARIANCE_SIGMA = 0.01
MIN_BIAS_ARCSEC = 1e-3  # keeps the prior invertible if nothing is shared
MIN_POSITION_KM = 1e-6

SHORTEST_DRAG_S = 1800.0  # in less the air moves no satellite above 300 km by its errors

# Columns of OBSERVATIONS that orbits are fitted to.
OBSERVED = [name for name in SHARED_OBSERVATIONS.names if name not in ("share", "row")]


class Start(NamedTuple):
    """An initial state of an object, GCRF [km, km/s], at a time in UTC since 1970 [ns]."""

    time_ns: int
    state: Array


def turned(rotation: Array, vectors: Array) -> Array:
    """Return rotated vectors (..., k), each the same whatever rows are beside it.

    Products of matrices and `einsum` add in an order that depends on the number of rows.
    """
    out = np.zeros_like(vectors, order="C")
    for i, j in np.ndindex(rotation.shape):
        out[..., i] += rotation[i, j] * vectors[..., j]
    return out


class FittedOrbit(NamedTuple):
    """An orbit at its epoch [s] after the noon of the night, with the names of its forces."""

    orbit: DeterminedOrbit
    epoch_s: float
    forces: str

    @property
    def dof(self) -> int:
        """Degrees of freedom of chi-square."""
        return 2 * int(self.orbit.used.sum()) - 6


class ObservedObjects(NamedTuple):
    """The observations of some objects: those of object k are ``offsets[k]:offsets[k + 1]``.

    `views` has them as directions, their sensors numbered over all objects and without a prior;
    `time_ns` (n,) is UTC since 1970; `tracklet` (n,) is from 0, -1 for none. `cov_shared` (n, 2)
    are the variances of the direction [rad^2] and the position [km^2] that the sensor's directions
    share.
    """

    names: list[str]
    sensors: list[str]
    offsets: Integers
    time_ns: Integers
    tracklet: Integers
    views: ObjectDirections
    cov_shared: Array

    def rows(self, k: int) -> slice:
        """Return the rows of object k."""
        return slice(int(self.offsets[k]), int(self.offsets[k + 1]))

    def slices(self) -> list[slice]:
        """Return the rows of each object."""
        return [self.rows(k) for k in range(len(self.names))]

    def sensor_sums(self, orbits: Mapping[int, FittedOrbit]) -> SensorSums:
        """Return what orbits of some objects, given by their numbers, tell of the sensors."""
        used = [self.rows(k).start + np.flatnonzero(f.orbit.used) for k, f in orbits.items()]
        rows = np.concatenate([np.zeros(0, np.int64), *used])
        of_objects = [np.unique(self.views.sensor[self.rows(k)]) for k in orbits]
        equations = [fitted.orbit.equations for fitted in orbits.values()]
        return summed_equations(
            self.sensors, list(zip(of_objects, equations, strict=True)),
            self.views.sensor[rows], self.cov_shared[rows],
        )  # fmt: skip

    def middle_ns(self, k: int) -> int:
        """Return the middle of an object's arc."""
        rows = self.rows(k)
        return (int(self.time_ns[rows.start]) + int(self.time_ns[rows.stop - 1])) // 2

    def directions(self, k: int) -> ObjectDirections:
        """Return the directions of object k.

        Sensors on one satellite may share the error of its position: see `platform_sizes`.
        """
        rows = self.rows(k)
        time_s, all_sensors, r_km, u, basis, weight, _ = self.views
        present, sensor = np.unique(all_sensors[rows], return_inverse=True)
        count = np.bincount(sensor)
        direction, position = (
            np.bincount(sensor, variance) / count for variance in self.cov_shared[rows].T
        )
        sizes = platform_sizes(time_s[rows], sensor, r_km[rows], np.sqrt(position))
        prior = np.zeros((len(present), 6, 6))
        for axis in range(3):
            prior[:, axis, axis] = 1.0 / direction
            prior[:, axis + 3, axis + 3] = 1.0 / (sizes * position)
        return ObjectDirections(
            time_s[rows], sensor.astype(np.int64), r_km[rows], u[rows], basis[rows], weight[rows],
            prior,
        )  # fmt: skip


def observed_objects(rows: pl.DataFrame, origin_ns: int, around: Surroundings) -> ObservedObjects:
    """Return the objects of OBSERVATIONS that are sorted by object and time."""
    R = around.R_night_from_gcrf
    u = unit_from_radec(
        np.radians(rows["ra_deg"].to_numpy()), np.radians(rows["dec_deg"].to_numpy())
    )
    sigma = rows.select("sigma_ra_arcsec", "sigma_dec_arcsec").to_numpy() * ARCSEC
    cov = sigma[:, :, None] * sigma[:, None, :]
    cov[:, [0, 1], [1, 0]] *= rows["correlation"].to_numpy()[:, None]
    names, sensors, tracklets = (
        factorize(rows.select(name).to_arrow(), name)
        for name in ("object_id", "sensor_id", "tracklet_id")
    )
    time_ns = rows["time"].cast(pl.Int64).to_numpy()
    smallest = np.array([MIN_BIAS_ARCSEC * ARCSEC, MIN_POSITION_KM])
    shared = rows.select("bias_sigma_arcsec", "position_sigma_km").to_numpy() * [ARCSEC, 1.0]
    return ObservedObjects(
        names=names.texts.tolist(),
        sensors=sensors.texts.tolist(),
        offsets=group_offsets(names.rank),
        time_ns=time_ns,
        tracklet=tracklets.rank,
        views=ObjectDirections(
            (time_ns - origin_ns) / SECOND_NS, sensors.rank,
            turned(R, rows.select(POSITION).to_numpy()), turned(R, u), turned(R, east_north(u)),
            _inverses(cov),
            np.zeros((0, 6, 6)),
        ),
        cov_shared=np.maximum(shared, smallest) ** 2,
    )  # fmt: skip


def _inverses(cov: Array) -> Array:
    """Return the inverses of (n, 2, 2) symmetric matrices."""
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    inverse = np.array([[c, -b], [-b, a]]) / (a * c - b * b)
    return np.ascontiguousarray(np.moveaxis(inverse, 2, 0))


def best_orbit(
    directions: ObjectDirections, start: Start | None, origin_ns: int, around: Surroundings
) -> FittedOrbit | None:
    """Return an object's orbit; None where no fit converges, or all directions are of one instant.

    Without an initial state, or where no fit from it converges, it comes from the directions.
    """
    if directions.time_s[0] == directions.time_s[-1]:
        return None
    found = None
    if start is not None:
        state = turned(state_rotation(around.R_night_from_gcrf), start.state)
        found = _from_state(directions, state, (start.time_ns - origin_ns) / SECOND_NS, around)
    return _without_start(directions, around) if found is None else found


def _without_start(directions: ObjectDirections, around: Surroundings) -> FittedOrbit | None:
    """Return the orbit by an initial state from the directions: of minutes, else of more of them.

    Of two that do not fit the first.
    """
    arc_s = float(directions.time_s[-1] - directions.time_s[0])
    first: FittedOrbit | None = None
    for longest_s in (LONGEST_S, LONGER_S) if arc_s > LONGEST_S else (LONGEST_S,):
        initial = initial_orbit(directions, around, log_density, longest_s)
        found = None if initial is None else _from_state(directions, *initial, around)
        if judge(found) is None:
            return found
        first = first or found
    return first


def _from_state(
    directions: ObjectDirections, state: Array, start_s: float, around: Surroundings
) -> FittedOrbit | None:
    """Return the orbit, from an initial state, whose forces explain the directions best."""
    first_s, last_s = float(directions.time_s[0]), float(directions.time_s[-1])
    epoch_s = (first_s + last_s) / 2
    found: list[tuple[float, FittedOrbit]] = []
    for force, areas in _possible_forces(state, last_s - first_s):
        orbit = determine_orbit(directions, state, start_s, epoch_s, areas, around)
        if np.isfinite(orbit.chi2):
            area = orbit.unknowns[6 if force == RADIATION else 7]
            forces = f"{GRAVITY} {force} {area:.4f} m2/kg" if force else GRAVITY
            found.append((log_evidence(orbit, areas), FittedOrbit(orbit, epoch_s, forces)))
    return (
        _with_neglected(max(found, key=lambda each: each[0])[1], last_s - first_s)
        if found
        else None
    )


def _with_neglected(fitted: FittedOrbit, arc_s: float) -> FittedOrbit:
    """Return an orbit whose covariance has what its forces neglect."""
    cov = fitted.orbit.cov.copy()
    cov[:6, :6] += neglected(fitted.orbit.unknowns[:3], arc_s)
    return fitted._replace(orbit=fitted.orbit._replace(cov=cov))


def _possible_forces(state: Array, arc_s: float) -> list[tuple[str, AreaPrior]]:
    """Return the forces that an orbit may have beside gravity, each with its prior."""
    none = (0.0, 0.0)
    if is_sunlit(state):
        return [(RADIATION, _prior(SUNLIT_AREA, none))]
    if arc_s > SHORTEST_DRAG_S:
        return [("", _prior(none, none)), (DRAG, _prior(none, AIR_AREA))]
    return [("", _prior(none, none))]


def _prior(*areas: tuple[float, float]) -> AreaPrior:
    return AreaPrior(np.array([mean for mean, _ in areas]), np.array([s for _, s in areas]))


def judge(fitted: FittedOrbit | None) -> Reason | None:
    """Return why an orbit cannot be published; None if it can."""
    if fitted is None:
        return Reason.NO_ORBIT
    # As if of fewer directions: a chi-square over its degrees of freedom has the variance 2 / dof.
    fewer = 1.0 + fitted.dof * VARIANCE_SIGMA**2 / 2
    fits = chdtrc(fitted.dof / fewer, fitted.orbit.chi2 / fewer) > MIN_PROBABILITY
    return None if fits else Reason.ORBIT_MISFIT

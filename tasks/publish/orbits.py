"""Orbits: one of each object of a night, fitted to all observations of it."""

import zlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
from scipy.special import chdtrc

from epipole.io.catalogues.earth_orientation import read_earth_orientation
from epipole.io.datasets.night_tables import NightReader, read_columns, write_table
from epipole.io.datasets.rows_by_night import in_order
from epipole.schemas.bridge import (
    concat,
    nullable,
    table,
    to_polars,
    unstack,
    unstack_covariance,
)
from epipole.schemas.columns import ELEMENTS, POSITION, STATE_AXES, VELOCITY
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.spans import DAY_NS
from epipole.schemas.stages import Stage
from epipole.schemas.tables import ORBITS, REJECTS
from epipole.tasks.algorithms.constants import (
    ARCSEC,
    DAY_S,
    EARTH_RADIUS_KM,
    GM_KM3_S2,
    SECOND_NS,
)
from epipole.tasks.algorithms.geometry.directions import east_north, unit_from_radec
from epipole.tasks.algorithms.orbits.forces import Surroundings, surroundings
from epipole.tasks.algorithms.orbits.initial_orbit import initial_orbit
from epipole.tasks.algorithms.orbits.object_motion import velocities
from epipole.tasks.algorithms.orbits.orbit_determination import (
    AreaPrior,
    ObjectDirections,
    determine_orbit,
    log_evidence,
)
from epipole.tasks.algorithms.orbits.orbital_elements import (
    element_errors,
    elements_of,
    geostationary,
)
from epipole.tasks.common.grouping import factorize, group_offsets
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.publish.fitted_observations import (
    FittedOrbit,
    fitted_part,
    turned,
    write_fitted,
)
from epipole.tasks.publish.sensor_errors import SensorSums, sensor_errors, summed_equations

Array = npt.NDArray[np.float64]

MIN_PROBABILITY = 1e-6  # of a chi-square: an orbit with a less probable one is rejected
ROWS_OF_TASK = 300_000  # observations, about
MIN_BIAS_ARCSEC = 1e-3  # keeps the prior invertible if nothing is shared
MIN_POSITION_KM = 1e-6
SLOPE_S = 60.0  # positions within this time of the middle one give the initial velocity

# Radiation moves what stays above this altitude more than air does.
RADIATION_KM = 1000.0
# Area over mass in sunlight, coefficient included: of satellites 0.01 to 0.05 m^2/kg. In the air
# twice that is usual, and the static density may be off by a factor of three.
SUNLIT_AREA, AIR_AREA = (0.02, 0.02), (0.03, 0.06)  # mean and sigma [m^2/kg]
SHORTEST_DRAG_S = 1800.0  # in less the air moves no satellite above 300 km by its errors
GRAVITY, RADIATION, DRAG = "GM J2-J4 C22 Sun Moon", "radiation", "drag"

_OBSERVED = [
    "time", "object_id", "tracklet_id", "sensor_id", "ra_deg", "dec_deg", "sigma_ra_arcsec",
    "sigma_dec_arcsec", "correlation", "bias_sigma_arcsec", *POSITION, "position_sigma_km",
]  # fmt: skip


class Start(NamedTuple):
    """An initial state of an object, GCRF [km, km/s], at a time in UTC since 1970 [ns]."""

    time_ns: int
    state: Array


class OrbitRows(NamedTuple):
    """ORBITS of some objects, and rows of `rejects` for the others.

    `misfits` are those of the others whose observations fit no orbit. `sensors` is what the orbits
    tell of the sensors' errors.
    """

    orbits: pa.Table
    rejects: pa.Table
    misfits: list[str]
    sensors: SensorSums


def orbit_shares(folder: Path, night: str) -> int:
    """Return into how many tasks the objects of a night are shared out."""
    return max(-(-NightReader.of_folder(folder, night).count("observations") // ROWS_OF_TASK), 1)


@stage_task(Stage.PUBLISH, "orbits {share} of {shares} of {night}")
def fit_orbits(
    folder: Path, night: str, share: int, shares: int, linked: pa.Table | None = None
) -> OrbitRows:
    """Fit the orbits of a share of the objects of a night whose other tables are written.

    The orbit of an object depends on the rows of this object only. `linked` are LINKED_ORBITS:
    the initial states of objects without positions. What an orbit adds to its observations goes to
    a part; see `write_fitted`.
    """
    reader = NightReader.of_folder(folder, night)
    observed = of_share(reader, "observations", _OBSERVED, share, shares)
    observed = observed.sort("object_id", "time", "sensor_id", "tracklet_id")
    around, origin_ns = surroundings_of(night), _noon_ns(night)
    objects = observed_objects(observed, origin_ns, around)
    starts = initial_states(reader, objects.names)
    if linked is not None:
        rows = to_polars(linked)
        starts = _starts(rows, rows.select(*POSITION, *VELOCITY).to_numpy()) | starts
    fitted = [
        best_orbit(objects.directions(k), starts.get(name), origin_ns, around)
        for k, name in enumerate(objects.names)
    ]
    reasons = [judge(each) for each in fitted]
    sound = {k: each for k, each in enumerate(fitted) if each is not None and reasons[k] is None}
    failed = [k for k in range(len(fitted)) if k not in sound]
    without = {objects.names[k] for k in failed}
    columns = ["time", "object_id", *POSITION]
    positions = of_share(reader, "positions", columns, share, shares)
    positions = positions.filter(pl.col("object_id").is_in(without))
    write_fitted(
        fitted_part(folder, share, shares), observed, objects.slices(), sound, positions, origin_ns,
        around,
    )  # fmt: skip
    return OrbitRows(
        orbit_table(objects, sound, origin_ns, around),
        reject_rows(
            [reason for reason in reasons if reason is not None],
            time=[objects.middle_ns(k) for k in failed],
            count=[1] * len(failed),
        ),
        [objects.names[k] for k in failed if reasons[k] == Reason.ORBIT_MISFIT],
        objects.sensor_sums(sound),
    )


@stage_task(Stage.PUBLISH, "orbits of {night}")
def write_orbits(folder: Path, night: str, fitted: Sequence[OrbitRows]) -> int:
    """Write the tables `orbits` and `sensor_errors` of a night, and add its rejects.

    Returns the number of orbits.
    """
    sums = [each.sensors for each in fitted]
    errors = sensor_errors(sums, surroundings_of(night).R_night_from_gcrf)
    write_table(folder, "sensor_errors", [errors])
    orbits = in_order(concat(ORBITS, [each.orbits for each in fitted]))
    earlier = read_columns(folder, "rejects", REJECTS.names)
    reasons = pa.array([reason.value for reason in (Reason.ORBIT_MISFIT, Reason.NO_ORBIT)])
    # A task that was killed as it wrote starts again.
    kept = earlier.filter(pc.invert(pc.is_in(earlier["reason"], reasons)))
    rejects = concat(REJECTS, [kept, *[each.rejects for each in fitted]])
    write_table(folder, "rejects", [in_order(rejects)])
    return write_table(folder, "orbits", [orbits])


def of_share(
    reader: NightReader, name: str, columns: Sequence[str], share: int, shares: int
) -> pl.DataFrame:
    """Return the rows of a share of the objects; the share follows from the id alone.

    `row` is each one's row in the night's table.
    """
    pieces = _pieces(reader, name, columns, share, shares)
    return pl.concat([reader.empty(name, columns).with_row_index("row"), *pieces])


def _pieces(
    reader: NightReader, name: str, columns: Sequence[str], share: int, shares: int
) -> Iterator[pl.DataFrame]:
    first = 0
    for piece in reader.pieces(name, columns):
        rows = piece.with_row_index("row", first).filter(pl.col("object_id").is_not_null())
        first += len(piece)
        ids = rows["object_id"].unique()
        mine = [name for name in ids if zlib.crc32(name.encode()) % shares == share]
        yield rows.filter(pl.col("object_id").is_in(mine))


def initial_states(reader: NightReader, objects: Sequence[str]) -> dict[str, Start]:
    """Return an initial state of each object: its best-observed state, else by its positions."""
    columns = ["epoch", "object_id", *POSITION, *VELOCITY, "n_views"]
    wanted = pl.col("object_id").is_in(list(objects))
    states = reader.read("states", columns).filter(wanted)
    best = states.sort("n_views", "epoch", descending=[True, False]).unique(
        "object_id", keep="first", maintain_order=True
    )
    found = _starts(best, best.select(*POSITION, *VELOCITY).to_numpy())
    columns = ["epoch", "object_id", *POSITION]
    without = wanted & pl.col("object_id").is_in(list(found)).not_()
    pieces = [rows.filter(without) for rows in reader.pieces("positions", columns)]
    for (_,), rows in pl.concat([reader.empty("positions", columns), *pieces]).group_by(
        ["object_id"], maintain_order=True
    ):
        found |= _from_positions(rows)
    return found


def _from_positions(rows: pl.DataFrame) -> dict[str, Start]:
    """Return the initial state of an object by its positions, in order of time."""
    time_ns, r_km = rows["epoch"].cast(pl.Int64).to_numpy(), rows.select(POSITION).to_numpy()
    ends = np.array([0, len(rows)])
    v_km_s, _ = velocities(ends, (time_ns - time_ns[0]) / SECOND_NS, r_km, SLOPE_S)
    middle = len(rows) // 2
    state = np.hstack([r_km, v_km_s])[middle : middle + 1]
    return _starts(rows[middle], state)


def _starts(rows: pl.DataFrame, states: Array) -> dict[str, Start]:
    times = rows["epoch"].cast(pl.Int64).to_list()
    return {
        name: Start(time_ns, state)
        for name, time_ns, state in zip(rows["object_id"], times, states, strict=True)
    }


def surroundings_of(night: str) -> Surroundings:
    """Return what acts on satellites in a night and half a day around it; times from its noon."""
    noon = _noon_ns(night)
    earth = read_earth_orientation()
    days = np.datetime64(night, "D") - np.datetime64("1858-11-17", "D")
    ut1_utc_s = float(np.interp(days.astype(float), earth.mjd, earth.ut1_utc_s))
    return surroundings(noon, noon - DAY_NS, noon + DAY_NS, ut1_utc_s)


def _noon_ns(night: str) -> int:
    return int(np.datetime64(night, "ns").astype(np.int64)) + DAY_NS // 2


class ObservedObjects(NamedTuple):
    """The observations of some objects: those of object k are ``offsets[k]:offsets[k + 1]``.

    `views` has them as directions, their sensors numbered over all objects and without a prior;
    `tracklet` is from 0, -1 for none. `cov_shared` (n, 2) are the variances of the direction
    [rad^2] and the position [km^2] that the sensor's directions share.
    """

    names: list[str]
    sensors: list[str]
    offsets: npt.NDArray[np.int64]
    time_ns: npt.NDArray[np.int64]
    tracklet: npt.NDArray[np.int64]
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
        """Return the directions of object k."""
        rows = self.rows(k)
        time_s, all_sensors, r_km, u, basis, weight, _ = self.views
        present, sensor = np.unique(all_sensors[rows], return_inverse=True)
        count = np.bincount(sensor)
        prior = np.zeros((len(present), 6, 6))
        for variance, axes in zip(self.cov_shared[rows].T, (range(3), range(3, 6)), strict=True):
            mean = np.bincount(sensor, variance) / count
            for axis in axes:
                prior[:, axis, axis] = 1.0 / mean
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
            np.asarray(np.linalg.inv(cov), float),
            np.zeros((0, 6, 6)),
        ),
        cov_shared=np.maximum(shared, smallest) ** 2,
    )  # fmt: skip


def _both(rotation: Array) -> Array:
    """Return the (6, 6) rotation of positions and velocities."""
    return np.asarray(np.kron(np.eye(2), rotation), float)


def best_orbit(
    directions: ObjectDirections, start: Start | None, origin_ns: int, around: Surroundings
) -> FittedOrbit | None:
    """Return an object's orbit; None where no fit converges.

    Without an initial state, or where no fit from it converges, it comes from the directions.
    """
    found = None
    if start is not None:
        state = turned(_both(around.R_night_from_gcrf), start.state)
        found = _from_state(directions, state, (start.time_ns - origin_ns) / SECOND_NS, around)
    if found is None and (initial := initial_orbit(directions, around)) is not None:
        found = _from_state(directions, *initial, around)
    return found


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
    return max(found, key=lambda each: each[0])[1] if found else None


def _possible_forces(state: Array, arc_s: float) -> list[tuple[str, AreaPrior]]:
    """Return the forces that an orbit may have beside gravity, each with its prior."""
    none = (0.0, 0.0)
    momentum2 = float(np.sum(np.cross(state[:3], state[3:]) ** 2))
    energy = float(state[3:] @ state[3:]) / 2 - GM_KM3_S2 / float(np.linalg.norm(state[:3]))
    e = np.sqrt(max(1 + 2 * energy * momentum2 / GM_KM3_S2**2, 0.0))
    if momentum2 / GM_KM3_S2 / (1 + e) > EARTH_RADIUS_KM + RADIATION_KM:
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
    fits = chdtrc(fitted.dof, fitted.orbit.chi2) > MIN_PROBABILITY
    return None if fits else Reason.ORBIT_MISFIT


def orbit_table(
    objects: ObservedObjects,
    orbits: Mapping[int, FittedOrbit],
    origin_ns: int,
    around: Surroundings,
) -> pa.Table:
    """Return ORBITS of objects, given by their numbers."""
    rows, fitted, n = list(orbits), list(orbits.values()), len(orbits)
    turn = _both(around.R_night_from_gcrf.T)
    state = turned(turn, np.array([each.orbit.unknowns[:6] for each in fitted]).reshape(n, 6))
    cov = np.array([turn @ each.orbit.cov[:6, :6] @ turn.T for each in fitted]).reshape(n, 6, 6)
    used = [np.flatnonzero(each.orbit.used) for each in fitted]
    at = [objects.rows(k).start + of_one for k, of_one in zip(rows, used, strict=True)]
    counted = {
        "epoch": np.array([origin_ns + round(o.epoch_s * SECOND_NS) for o in fitted], np.int64),
        "object_id": [objects.names[k] for k in rows],
        "n_sensors": [len(np.unique(objects.views.sensor[of_one])) for of_one in at],
        "n_tracklets": [np.sum(np.unique(objects.tracklet[of_one]) >= 0) for of_one in at],
        "n_observations": [len(of_one) for of_one in used],
        "arc_s": [np.ptp(objects.time_ns[of_one]) / SECOND_NS for of_one in at],
        "chi2": [each.orbit.chi2 for each in fitted],
        "dof": [each.dof for each in fitted],
        "forces": [each.forces for each in fitted],
    }
    degrees = np.array([1.0, 1.0, *np.degrees(np.ones(4))])
    return table(
        ORBITS,
        {
            **counted,
            **unstack("{}_km", state[:, :3]),
            **unstack("v{}_km_s", state[:, 3:]),
            **unstack_covariance("cov_{}", cov, STATE_AXES),
            **unstack("{}", elements_of(state) * degrees, ELEMENTS),
            **unstack("sigma_{}", element_errors(state, cov) * degrees, ELEMENTS),
            **_longitudes(fitted, around),
        },
    )


def _longitudes(fitted: Sequence[FittedOrbit], around: Surroundings) -> dict[str, pa.Array]:
    """Return longitude and drift of the geostationary ones, and their errors; else nulls."""
    values = np.full((len(fitted), 4), np.nan)
    for k, (orbit, epoch_s, _) in enumerate(fitted):
        found = geostationary(orbit.unknowns, orbit.cov, epoch_s, around)
        if found is not None:
            values[k] = np.degrees(found) * [1.0, 1.0, DAY_S, DAY_S]
    names = ("longitude_deg", "sigma_longitude_deg", "drift_deg_day", "sigma_drift_deg_day")
    return {name: nullable(values[:, k]) for k, name in enumerate(names)}

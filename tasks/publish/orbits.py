"""Orbits: one of each object of a night, fitted to all observations of it."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.datasets.night_tables import NightReader, read_columns, write_table
from epipole.io.datasets.rows_by_night import in_order
from epipole.schemas.arrays import Array
from epipole.schemas.bridge import (
    concat,
    nullable,
    table,
    to_polars,
    unstack,
    unstack_covariance,
)
from epipole.schemas.columns import ELEMENTS, POSITION, STATE_AXES, VELOCITY
from epipole.schemas.rejects import ObjectVerdict, Reason, reject_rows
from epipole.schemas.stages import Stage
from epipole.schemas.tables import ORBITS, REJECTS
from epipole.tasks.algorithms.constants import DAY_S, SECOND_NS
from epipole.tasks.algorithms.orbits.forces import Surroundings
from epipole.tasks.algorithms.orbits.object_motion import velocities
from epipole.tasks.algorithms.orbits.orbital_elements import (
    IN_DEGREES,
    element_errors,
    elements_of,
    geostationary,
)
from epipole.tasks.algorithms.orbits.reference_frames import state_rotation
from epipole.tasks.common.orbit_forces import noon_ns, surroundings_of
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.publish.fitted_observations import fitted_part, write_fitted
from epipole.tasks.publish.manoeuvres import find_manoeuvre
from epipole.tasks.publish.object_orbits import (
    FittedOrbit,
    ObservedObjects,
    Start,
    best_orbit,
    judge,
    observed_objects,
    turned,
)
from epipole.tasks.publish.sensor_errors import SensorSums, sensor_errors
from epipole.tasks.publish.share_out import of_share

ROWS_OF_TASK = 300_000  # observations, about
OF_ORBITS = (Reason.MANOEUVRE, Reason.ORBIT_MISFIT, Reason.NO_ORBIT)
SLOPE_S = 60.0  # positions within this time of the middle one give the initial velocity


class OrbitRows(NamedTuple):
    """ORBITS of some objects, and rows of `rejects` for the others.

    `verdicts` are those of objects whose observations fit no single orbit. `sensors` are the sums
    from which the sensors' errors are estimated.
    """

    orbits: pa.Table
    rejects: pa.Table
    verdicts: dict[str, ObjectVerdict]
    sensors: SensorSums


def orbit_shares(folder: Path, night: str) -> int:
    """Return the number of tasks among which the objects of a night are shared."""
    return max(-(-NightReader.of_folder(folder, night).count("observations") // ROWS_OF_TASK), 1)


@stage_task(Stage.PUBLISH, "orbits {share} of {shares} of {night}")
def fit_orbits(
    folder: Path, night: str, share: int, shares: int, linked: pa.Table | None = None
) -> OrbitRows:
    """Fit the orbits of a share of the objects of a night, after `share_out`.

    The orbit of an object depends on the rows of this object only. `linked` are LINKED_ORBITS:
    the initial states of objects that an orbit joined. What an orbit adds to its observations goes
    to a part; see `write_fitted`.
    """
    reader = NightReader.of_folder(folder, night)
    observed = of_share(folder, "observations", share)
    observed = observed.sort("object_id", "time", "sensor_id", "tracklet_id")
    around, origin_ns = surroundings_of(night), noon_ns(night)
    objects = observed_objects(observed, origin_ns, around)
    positions = of_share(folder, "positions", share)
    starts = initial_states(reader, objects.names, positions)
    if linked is not None:
        rows = to_polars(linked)
        starts |= _starts(rows, rows.select(*POSITION, *VELOCITY).to_numpy())
    fitted = [
        best_orbit(objects.directions(k), starts.get(name), origin_ns, around)
        for k, name in enumerate(objects.names)
    ]
    reasons = [judge(each) for each in fitted]
    changed = {
        k: found
        for k, each in enumerate(fitted)
        if each is not None
        and reasons[k] == Reason.ORBIT_MISFIT
        and (found := find_manoeuvre(objects.directions(k), each, origin_ns, around))
    }
    for k, manoeuvre in changed.items():
        fitted[k], reasons[k] = manoeuvre.after, None
    sound = {k: each for k, each in enumerate(fitted) if each is not None and reasons[k] is None}
    failed = [k for k in range(len(fitted)) if k not in sound]
    without = {objects.names[k] for k in failed}
    positions = positions.filter(pl.col("object_id").is_in(without))
    write_fitted(
        fitted_part(folder, share, shares), observed, objects.slices(), sound, changed, positions,
        origin_ns, around,
    )  # fmt: skip
    times_ns = [objects.middle_ns(k) for k in failed]
    times_ns += [origin_ns + round(each.time_s * SECOND_NS) for each in changed.values()]
    misfits = [k for k in failed if reasons[k] == Reason.ORBIT_MISFIT]
    return OrbitRows(
        orbit_table(objects, sound, origin_ns, around),
        reject_rows(
            [*filter(None, reasons), *[Reason.MANOEUVRE] * len(changed)],
            time=times_ns,
            count=[*[1] * len(failed), *(each.n_before for each in changed.values())],
        ),
        {objects.names[k]: ObjectVerdict.ORBIT_MISFIT for k in misfits}
        | {objects.names[k]: ObjectVerdict.MANOEUVRED for k in changed},
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
    reasons = pa.array([reason.value for reason in OF_ORBITS])
    # A task that was killed as it wrote starts again.
    kept = earlier.filter(pc.invert(pc.is_in(earlier["reason"], reasons)))
    rejects = concat(REJECTS, [kept, *[each.rejects for each in fitted]])
    write_table(folder, "rejects", [in_order(rejects)])
    return write_table(folder, "orbits", [orbits])


def initial_states(
    reader: NightReader, objects: Sequence[str], positions: pl.DataFrame
) -> dict[str, Start]:
    """Return an initial state of each object: its best-observed state, else by its positions."""
    columns = ["epoch", "object_id", *POSITION, *VELOCITY, "n_views"]
    wanted = pl.col("object_id").is_in(list(objects))
    states = reader.read("states", columns).filter(wanted)
    best = states.sort("n_views", "epoch", descending=[True, False]).unique(
        "object_id", keep="first", maintain_order=True
    )
    found = _starts(best, best.select(*POSITION, *VELOCITY).to_numpy())
    without = wanted & pl.col("object_id").is_in(list(found)).not_()
    for _, rows in positions.filter(without).group_by(["object_id"], maintain_order=True):
        found |= _from_positions(rows)
    return found


def _from_positions(rows: pl.DataFrame) -> dict[str, Start]:
    """Return the initial state of an object by its positions, in order of time.

    Empty if its middle position has no other near in time: it shows no velocity.
    """
    time_ns, r_km = rows["epoch"].cast(pl.Int64).to_numpy(), rows.select(POSITION).to_numpy()
    ends = np.array([0, len(rows)])
    v_km_s, spread_s = velocities(ends, (time_ns - time_ns[0]) / SECOND_NS, r_km, SLOPE_S)
    middle = len(rows) // 2
    if not spread_s[middle]:
        return {}
    state = np.hstack([r_km, v_km_s])[middle : middle + 1]
    return _starts(rows[middle], state)


def _starts(rows: pl.DataFrame, states: Array) -> dict[str, Start]:
    times = rows["epoch"].cast(pl.Int64).to_list()
    return {
        name: Start(time_ns, state)
        for name, time_ns, state in zip(rows["object_id"], times, states, strict=True)
    }


def orbit_table(
    objects: ObservedObjects,
    orbits: Mapping[int, FittedOrbit],
    origin_ns: int,
    around: Surroundings,
) -> pa.Table:
    """Return ORBITS of objects, given by their numbers."""
    rows, fitted, n = list(orbits), list(orbits.values()), len(orbits)
    turn = state_rotation(around.R_night_from_gcrf.T)
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
    return table(
        ORBITS,
        {
            **counted,
            **unstack("{}_km", state[:, :3]),
            **unstack("v{}_km_s", state[:, 3:]),
            **unstack_covariance("cov_{}", cov, STATE_AXES),
            **unstack("{}", elements_of(state) * IN_DEGREES, ELEMENTS),
            **unstack("sigma_{}", element_errors(state, cov) * IN_DEGREES, ELEMENTS),
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

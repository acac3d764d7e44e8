"""Fitted observations: what an object's orbit, or its positions, add to its observations."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.datasets.night_tables import NightReader, rewrite_table
from epipole.io.work.parts import FITTED, read_part, write_part
from epipole.schemas.arrays import Array, Integers
from epipole.schemas.bridge import array, from_polars, nullable, table, to_polars
from epipole.schemas.columns import POSITION
from epipole.schemas.observation import FITTED_FIELDS
from epipole.schemas.stages import Stage
from epipole.schemas.tables import OBSERVATIONS
from epipole.schemas.work_tables import FITTED_OBSERVATIONS
from epipole.tasks.algorithms.constants import SECOND_NS, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import lengths
from epipole.tasks.algorithms.orbits.forces import Surroundings
from epipole.tasks.algorithms.orbits.illumination import illumination, reduced_magnitude
from epipole.tasks.algorithms.orbits.orbit_determination import BACK_S
from epipole.tasks.algorithms.orbits.trajectories import integrate, positions_at
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.publish.manoeuvres import Manoeuvre
from epipole.tasks.publish.object_orbits import FittedOrbit, turned

# Maximum time between positions that a straight line joins: it is within 1 km in low orbit.
MAX_APART_S = 30.0
LIGHT_ITERATIONS = 3  # of the light time: right to 1e-12 of the distance


def fitted_part(folder: Path, share: int, shares: int) -> Path:
    """Return the part with FITTED_OBSERVATIONS of a share of a night's objects."""
    return folder.with_name(f"{folder.name}-fitted") / f"{share}-of-{shares}"


def write_fitted(
    part: Path,
    observed: pl.DataFrame,
    objects: Sequence[slice],
    orbits: Mapping[int, FittedOrbit],
    manoeuvres: Mapping[int, Manoeuvre],
    positions: pl.DataFrame,
    origin_ns: int,
    around: Surroundings,
) -> None:
    """Write what the orbits, or the positions, of objects add to their observations.

    Parameters
    ----------
    observed
        OBSERVATIONS with the column `row`, by object.
    objects
        The rows of each object.
    orbits, manoeuvres
        By the number of the object. An orbit is that after a manoeuvre.
    positions
        POSITIONS of the objects without orbit, in order of time.
    origin_ns
        Time from which those of the orbits and of `around` count.
    """
    time_ns, sensor_km = _times(observed), observed.select(POSITION).to_numpy()
    r_km, residual = np.full_like(sensor_km, np.nan), np.full(len(time_ns), np.nan)
    solved = dict(positions.partition_by("object_id", as_dict=True))
    for k, rows in enumerate(objects):
        if k in orbits:
            time_s = (time_ns[rows] - origin_ns) / SECOND_NS
            r_km[rows] = _by_orbit(orbits[k], time_s, sensor_km[rows], around)
            if k in manoeuvres:
                before, n = manoeuvres[k].before, manoeuvres[k].n_before
                early = slice(rows.start, rows.start + n)
                r_km[early] = _by_orbit(before, time_s[:n], sensor_km[early], around)
            residual[rows] = np.sqrt(orbits[k].orbit.of_directions)
        elif (of_object := solved.get((observed["object_id"][rows.start],))) is not None:
            r_km[rows] = _by_positions(of_object, time_ns[rows], sensor_km[rows])
    seen = illumination(time_ns, r_km, sensor_km)
    known = np.isfinite(seen.range_km)
    order = np.argsort(observed["row"].to_numpy())
    columns = {
        "row": observed["row"].cast(pl.Int64).to_numpy()[order],
        "residual_sigma": nullable(residual[order]),
        "range_km": nullable(seen.range_km[order]),
        "phase_deg": nullable(np.degrees(seen.phase_rad)[order]),
        "sunlit": nullable(seen.sunlit[order], known[order]),
    }
    write_part(part, FITTED, {"observations": table(FITTED_OBSERVATIONS, columns)})


def _times(rows: pl.DataFrame) -> Integers:
    return rows["time"].cast(pl.Int64).to_numpy()


def _by_orbit(fitted: FittedOrbit, time_s: Array, sensor_km: Array, around: Surroundings) -> Array:
    """Return where an object was when the light left that came at times, (n, 3) [km], GCRF."""
    first_s, last_s = float(time_s.min()) - BACK_S, float(time_s.max())
    path = integrate(fitted.orbit.unknowns, fitted.epoch_s, first_s, last_s, around)
    R = around.R_night_from_gcrf.T
    delay_s = np.zeros(len(time_s))
    for _ in range(LIGHT_ITERATIONS):
        r_km = turned(R, positions_at(path, time_s - delay_s))
        delay_s = lengths(r_km - sensor_km) / SPEED_OF_LIGHT_KM_S
    return r_km


def _by_positions(positions: pl.DataFrame, time_ns: Integers, sensor_km: Array) -> Array:
    """Return the same, on straight lines between positions; NaN where none are near in time."""
    solved_ns, known = _times(positions), positions.select(POSITION).to_numpy()
    solved_s, time_s = ((t - solved_ns[0]) / SECOND_NS for t in (solved_ns, time_ns))
    delay_s = np.zeros(len(time_s))
    for _ in range(LIGHT_ITERATIONS):
        at_s = time_s - delay_s
        after = np.searchsorted(solved_s, at_s)
        inside = (after > 0) & (after < len(solved_s))
        after = np.where(inside, after, 1)
        r_km = np.column_stack([np.interp(at_s, solved_s, axis) for axis in known.T])
        step_s = np.diff(solved_s, append=np.inf)[after - 1]
        r_km[~(inside & (step_s <= MAX_APART_S))] = np.nan
        distance_km = lengths(r_km - sensor_km)
        delay_s = np.nan_to_num(distance_km / SPEED_OF_LIGHT_KM_S)
    return r_km


@stage_task(Stage.PUBLISH, "observations of {night}")
def complete_observations(folder: Path, night: str, shares: int) -> None:
    """Write the table `observations` of a night again, with what `write_fitted` left."""
    reader = NightReader.of_folder(folder, night)
    parts = [
        read_part(fitted_part(folder, share, shares), "observations") for share in range(shares)
    ]
    rewrite_table(folder, "observations", _completed(reader, parts))


def _completed(reader: NightReader, parts: Sequence[pa.Table]) -> Iterator[pa.Table]:
    names = [field.name for field in FITTED_FIELDS]
    measured = [name for name in OBSERVATIONS.names if name not in names]
    numbers = [array(part, "row") for part in parts]
    first = 0
    for piece in reader.pieces("observations", measured):
        ends = [np.searchsorted(number, [first, first + len(piece)]) for number in numbers]
        fitted = pl.concat(
            to_polars(part.slice(a, b - a)) for part, (a, b) in zip(parts, ends, strict=True)
        )
        rows = piece.with_row_index("row", first).with_columns(pl.col("row").cast(pl.Int64))
        rows = rows.join(fitted, on="row", how="left", maintain_order="left")
        magnitude, range_km = (
            rows[n].cast(pl.Float64).to_numpy() for n in ("magnitude", "range_km")
        )
        reduced = pl.Series(reduced_magnitude(magnitude, range_km)).fill_nan(None)
        yield from_polars(OBSERVATIONS, rows.with_columns(magnitude_1000_km=reduced))
        first += len(piece)

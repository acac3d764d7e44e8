"""Earlier objects: the ids that unknown objects had in nights before, by their orbits.

The last orbit of an earlier object is moved to the orbits of the night, under the forces that
orbits are fitted with. For an object without an orbit, its last state is moved.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.datasets.night_tables import read_columns
from epipole.schemas.arrays import Array, Indices
from epipole.schemas.bridge import stack_covariance, to_polars
from epipole.schemas.columns import POSITION, STATE_AXES, VELOCITY
from epipole.schemas.tables import ORBITS, STATES
from epipole.tasks.algorithms.constants import DAY_S, GM_KM3_S2, SECOND_NS
from epipole.tasks.algorithms.orbits.forces import N_UNKNOWNS
from epipole.tasks.algorithms.orbits.object_linking import ObservedMotions, link_by_motion
from epipole.tasks.algorithms.orbits.reference_frames import state_rotation
from epipole.tasks.algorithms.orbits.trajectories import (
    integrate,
    positions_at,
    propagate_unknowns,
)
from epipole.tasks.common.orbit_forces import (
    AIR_AREA,
    SUNLIT_AREA,
    areas_in,
    is_sunlit,
    noon_ns,
    surroundings_of,
)

HOUR_S = 3600.0
MAX_SIGMA_KM = 100.0  # of a position: vaguer orbits are not moved over hours
# Farther from the moved orbit it is another object. An orbit with larger errors recognises nothing.
NEAR_KM = 1500.0
# What the forces neglect, in position along each axis [km] per day: some 0.3 by the rest of the
# Earth's field. Estimated, so that it holds for objects that follow SGP4: six of seven true pairs
# of two simulated days are then within their covariance, and the seventh is too vague.
NEGLECTED_KM_PER_DAY = 2.0

_STATE = [*POSITION, *VELOCITY]
_COVARIANCE = [name for name in ORBITS.names if name.startswith("cov_")]


class EarlierObjects(NamedTuple):
    """The last STATES and ORBITS of objects before a night."""

    states: pa.Table
    orbits: pa.Table


class EarlierViews(NamedTuple):
    """The end of the night before, as published: OBJECT_DETECTIONS, and LAST_FRAMES."""

    detections: pa.Table
    frames: pa.Table


def recognise_objects(
    folder: Path, objects: Sequence[str], earlier: EarlierObjects, earlier_h: float, log_odds: float
) -> dict[str, str]:
    """Return the ids that objects of a night had in an earlier one, where their motion decides.

    Parameters
    ----------
    folder
        The night's folder; its `states` and `orbits` are written.
    objects
        Ids of the objects to recognise. Ids that an earlier night knows already are skipped.
    earlier_h
        Longest time from the last detection of an earlier object to the first of a new one
        [hours].
    log_odds
        Minimum log odds; see `link_by_motion` for when a link is refused.

    Notes
    -----
    Ids of one night, and of earlier ones, may be one object: each is compared with all later ones.
    Else two earlier ids of one object would both be meant, and neither found.
    """
    before = _motions(to_polars(earlier.states), to_polars(earlier.orbits), "last")
    if not (len(objects) and len(before) and earlier_h > 0.0):
        return {}
    states, orbits = (
        pl.DataFrame(read_columns(folder, name, schema.names))
        for name, schema in (("states", STATES), ("orbits", ORBITS))
    )
    new = _motions(states, orbits, "first")
    known = before["object_id"].to_list()
    new = new.filter(pl.col("object_id").is_in(list(objects)) & ~pl.col("object_id").is_in(known))
    if not len(new):
        return {}
    both = pl.concat([before, new])
    motions = _observed(both)
    mover = _Mover(both, motions, earlier_h * HOUR_S)
    links, _ = link_by_motion(
        motions, gap_s=earlier_h * HOUR_S, log_odds=log_odds, allowed=mover.near, moved=mover.moved
    )
    names, n = both["object_id"].to_list(), len(before)
    found = {k: _last_before(links, k, n) for k in range(n, len(names))}
    return {names[k]: names[i] for k, i in found.items() if i >= 0}


def _last_before(links: Indices, k: int, n: int) -> int:
    """Return the last of the first n objects in the chain of links that ends at k; -1: none."""
    while k >= n:
        k = int(links[k])
    return k


def _motions(
    states: pl.DataFrame, orbits: pl.DataFrame, keep: Literal["first", "last"]
) -> pl.DataFrame:
    """Return a row per object, in order of ids: the orbit or state of its first or last night."""
    columns = ["object_id", "epoch", "half_s", "forces", *_STATE, *_COVARIANCE]
    of_states = states.with_columns(half_s=pl.lit(0.0), forces=pl.lit("")).select(columns)
    of_orbits = orbits.with_columns(
        half_s=pl.col("arc_s") / 2, forces=pl.col("forces").cast(pl.String)
    ).select(columns)
    rows = pl.concat([of_states, of_orbits]).filter(
        pl.all_horizontal(pl.col(*_STATE, *_COVARIANCE).is_finite()),
        pl.sum_horizontal("cov_xx", "cov_yy", "cov_zz") < MAX_SIGMA_KM**2,
    )
    # Of one night, the orbit is preferred to the state: it is fitted to all observations.
    date, is_state = pl.col("epoch").dt.date(), pl.col("forces") == ""
    if keep == "last":
        rows = rows.sort(date, ~is_state, "epoch")
    else:
        rows = rows.sort(date, is_state, "epoch")
    return rows.unique("object_id", keep=keep, maintain_order=True).sort("object_id")


def _observed(rows: pl.DataFrame) -> ObservedMotions:
    """Return the motions, each known at one instant; times [s] count from the first one."""
    time_ns = rows["epoch"].cast(pl.Int64).to_numpy()
    at_s, half_s = (time_ns - time_ns.min()) / SECOND_NS, rows["half_s"].to_numpy()
    motion, cov = rows.select(_STATE).to_numpy(), stack_covariance(rows, "cov_{}", STATE_AXES)
    return ObservedMotions(at_s - half_s, at_s + half_s, at_s, at_s, motion, motion, cov, cov)


class _Mover:
    """Moves motions to the epochs of later ones, by the forces of orbits.

    `near` (m, m): motion i, moved, is within `NEAR_KM` of motion j, which begins up to `gap_s`
    after its end.
    """

    def __init__(self, rows: pl.DataFrame, motions: ObservedMotions, gap_s: float) -> None:
        time_ns = rows["epoch"].cast(pl.Int64).to_numpy()
        first = np.datetime64(int(time_ns.min()), "ns").astype("datetime64[D]")
        noon = noon_ns(str(first))
        self.around = surroundings_of(str(first), int(time_ns.max()) - noon)
        self.epoch_s = (time_ns - noon) / SECOND_NS
        self.R = state_rotation(self.around.R_night_from_gcrf)
        motion, cov = motions.tail, motions.tail_cov
        areas = [_areas(*each) for each in zip(motion, rows["forces"], strict=True)]
        self.unknowns = np.concatenate([motion @ self.R.T, [mean for mean, _ in areas]], axis=1)
        self.cov = np.zeros((len(rows), N_UNKNOWNS, N_UNKNOWNS))
        self.cov[:, :6, :6] = self.R @ cov @ self.R.T
        self.cov[:, [6, 7], [6, 7]] = np.square([sigma for _, sigma in areas])
        self.near = np.zeros((len(rows), len(rows)), bool)
        for i, end_s in enumerate(motions.last_s.tolist()):
            gaps_s = motions.first_s - end_s
            later = np.flatnonzero((gaps_s > 0.0) & (gaps_s <= gap_s))
            if len(later):
                self.near[i, later] = self._distances_km(i, later) < NEAR_KM

    def _distances_km(self, i: int, later: Indices) -> Array:
        """Return how far the later objects are from motion i at their epochs."""
        times_s = self.epoch_s[later]
        try:
            path = integrate(
                self.unknowns[i], self.epoch_s[i], times_s.min(), times_s.max(), self.around
            )
        except ValueError:  # it falls to the ground
            return np.full(len(times_s), np.inf)
        off_km = positions_at(path, times_s) - self.unknowns[later, :3]
        return np.asarray(np.linalg.norm(off_km, axis=1))

    def moved(self, i: int, dt_s: Array) -> tuple[Array, Array]:
        """Return states (m, 6) of motion i after times (m,) in order, GCRF, and covariances."""
        states, covariances = np.zeros((len(dt_s), 6)), np.zeros((len(dt_s), 6, 6))
        unknowns, transition, now_s = self.unknowns[i], np.eye(N_UNKNOWNS), self.epoch_s[i]
        for k, to_s in enumerate((self.epoch_s[i] + dt_s).tolist()):
            unknowns, step = propagate_unknowns(unknowns, now_s, to_s, self.around)
            transition, now_s = step @ transition, to_s
            cov = (transition @ self.cov[i] @ transition.T)[:6, :6]
            covariances[k] = self.R.T @ cov @ self.R + _neglected(unknowns, dt_s[k])
            states[k] = self.R.T @ unknowns[:6]
        return states, covariances


def _areas(state: Array, forces: str) -> tuple[list[float], list[float]]:
    """Return the mean and sigma of the areas over mass in sunlight and in the air [m^2/kg].

    Those that `forces` does not have, as the arc was too short to show them, are the usual ones.
    """
    named = areas_in(forces)
    usual = [SUNLIT_AREA, (0.0, 0.0)] if is_sunlit(state) else [(0.0, 0.0), AIR_AREA]
    means = [area or mean for area, (mean, _) in zip(named, usual, strict=True)]
    return means, [sigma for _, sigma in usual]


def _neglected(state: Array, dt_s: float) -> Array:
    """Return the covariance (6, 6) [km, km/s] of the neglected forces after a time [s]."""
    sigma_km = NEGLECTED_KM_PER_DAY * dt_s / DAY_S
    motion = np.sqrt(GM_KM3_S2 / np.linalg.norm(state[:3]) ** 3)
    return np.diag(np.repeat([sigma_km, motion * sigma_km], 3) ** 2)

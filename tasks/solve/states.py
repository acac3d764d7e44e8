"""Fit states: position and velocity of each object, arc by arc."""

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
from scipy.special import chdtrc

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.schemas.bridge import array, empty, table, unstack, unstack_covariance
from epipole.schemas.columns import STATE_AXES
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.settings import StateSettings
from epipole.schemas.tables import STATES
from epipole.schemas.work_tables import SHARED_ERRORS
from epipole.tasks.algorithms.geometry.covariances import traces
from epipole.tasks.algorithms.orbits.object_motion import velocities
from epipole.tasks.algorithms.orbits.orbit_fit import (
    Arcs,
    FittedOrbits,
    fit_orbits,
    prior_information,
)
from epipole.tasks.algorithms.orbits.shared_errors import ArcEquations, scale_shared_errors
from epipole.tasks.common.grouping import group_offsets
from epipole.tasks.solve.positions import shared_position_sigmas
from epipole.tasks.solve.view_groups import ViewGroups

MIN_PROBABILITY = 1e-6  # of a chi-square: a state with a less probable one is rejected
# Chi-square per degree of freedom over the median of all arcs: an arc above this mixes objects.
MAX_CHI2_RATIO = 3.0
SLOPE_S = 60.0  # positions within this time of an arc's middle give the initial velocity


def fit_states(groups: ViewGroups, settings: StateSettings) -> pa.Table:
    """Return STATES: one for each object and arc, at the arc's middle epoch; NaN if a fit fails.

    Only the views used for `independent` positions are fitted: no two of these share a detection.
    Each sensor's common error is estimated together with the state.
    """
    named = _arcs_of(groups, settings)
    if not len(named.middle_ns):
        return empty(STATES)
    fitted = fit_orbits(named.arcs, _starts(groups, named))
    counts = {"n_epochs": named.n_epochs, "n_views": np.diff(named.arcs.offsets)}
    return _state_table(named, fitted, counts)


def judge_errors(groups: ViewGroups, settings: StateSettings) -> pa.Table:
    """Return SHARED_ERRORS: the sensors whose shared errors are larger than stated.

    The size of the errors that a sensor's views share is estimated from all objects together; see
    `scale_shared_errors`.
    """
    named = _arcs_of(groups, settings)
    if not len(named.middle_ns):
        return empty(SHARED_ERRORS)
    arcs, sensor_ids = named.arcs, named.sensor_ids
    fitted = fit_orbits(arcs, _starts(groups, named))
    prior = prior_information(arcs, slice(None), arcs.sensor, len(sensor_ids))
    has_bias = np.bincount(arcs.sensor, traces(arcs.cov_bias)) > 0.0
    free = np.column_stack([has_bias, np.ones(len(sensor_ids), bool)])
    equations = _unmixed_arcs(fitted, np.diff(arcs.offsets))
    factor = scale_shared_errors(equations, prior, free)
    larger = np.flatnonzero((factor > 1.0).any(axis=1))
    return table(
        SHARED_ERRORS,
        {
            "sensor_id": sensor_ids[larger].tolist(),
            "direction": factor[larger, 0],
            "position": factor[larger, 1],
        },
    )


def _unmixed_arcs(fitted: FittedOrbits, n_views: Indices) -> list[tuple[Indices, ArcEquations]]:
    """Return the equations of the arcs that do not mix objects."""
    reduced = fitted.chi2 / np.maximum(2 * n_views - 6, 1)
    # A sensor with a large error makes all its arcs fit badly; mixed objects spoil one arc.
    usual = max(1.0, float(np.nanmedian(reduced))) if np.isfinite(reduced).any() else 1.0
    return [fitted.equations[k] for k in np.flatnonzero(reduced < MAX_CHI2_RATIO * usual)]


class _NamedArcs(NamedTuple):
    """Arcs, each with its object, middle epoch and number of epochs; and the sensors' ids.

    `solved` are the groups that have a position, by object and epoch.
    """

    solved: Indices
    arcs: Arcs
    sensor_ids: npt.NDArray[np.str_]
    object_id: npt.NDArray[np.object_]
    middle_ns: Indices
    n_epochs: Indices


def _arcs_of(groups: ViewGroups, settings: StateSettings) -> _NamedArcs:
    """Return the arcs of all objects: the used views of independent positions."""
    solved = _by_object(groups)
    rows, arc = _rows_of_arcs(groups, solved, settings)
    views, sensor_ids = groups.views.take(rows), groups.views.sensor_ids
    present, sensor = np.unique(views.sensor, return_inverse=True)
    offsets = group_offsets(arc) if len(arc) else np.zeros(1, np.int64)
    epochs = [np.unique(views.epoch_ns[lo:hi]) for lo, hi in itertools.pairwise(offsets)]
    n_epochs = np.array([len(of_arc) for of_arc in epochs], np.int64)
    middle = np.array([of_arc[len(of_arc) // 2] for of_arc in epochs], np.int64)
    arcs = Arcs(
        offsets=offsets,
        time_s=(views.epoch_ns - np.repeat(middle, np.diff(offsets))) / 1e9,
        sensor=sensor.astype(np.int64),
        r_km=views.r_km,
        u=views.u,
        cov_noise=views.cov_noise,
        cov_bias=views.cov_bias,
        sigma_km=shared_position_sigmas(groups.offsets, groups.views)[rows],
    )
    object_id = groups.object_id[groups.group[rows[offsets[:-1]]]]
    return _NamedArcs(solved, arcs, sensor_ids[present], object_id, middle, n_epochs)


def _rows_of_arcs(
    groups: ViewGroups, solved: Indices, settings: StateSettings
) -> tuple[Indices, Indices]:
    """Return the rows of the views to fit, by arc, epoch and sensor, and the arc of each."""
    name, kept = groups.object_id[solved], groups.independent[solved]
    arc = _arcs(name, groups.epoch_ns[solved], settings.arc_s)
    arc = np.where(kept & _long_enough(arc, kept, settings.min_epochs), arc, -1)
    of_group = np.full(len(groups.epoch_ns), -1)
    of_group[solved] = arc
    of_view = of_group[groups.group]
    rows = np.flatnonzero(groups.used & (of_view >= 0))
    views = groups.views
    rows = rows[np.lexsort((views.sensor[rows], views.epoch_ns[rows], of_view[rows]))]
    return rows, of_view[rows]


def _by_object(groups: ViewGroups) -> Indices:
    """Return the groups that have a position, by object and epoch."""
    solved = np.flatnonzero(groups.solved)
    return solved[np.lexsort((groups.epoch_ns[solved], groups.object_id[solved].astype(str)))]


class FittingStates(NamedTuple):
    """STATES whose chi-square fits, and rows of `rejects` for the others."""

    states: pa.Table
    rejects: pa.Table


def refuse_misfits(states: pa.Table) -> FittingStates:
    """Return the states whose chi-square fits their degrees of freedom.

    Other states mix two objects, or the errors of their views are larger than stated. Their
    covariances are not valid. Failed fits are among them: their chi-square is NaN.
    """
    fits = chdtrc(array(states, "dof"), array(states, "chi2")) > MIN_PROBABILITY
    misfits = states.filter(pa.array(~fits)).sort_by("epoch")
    count = np.ones(misfits.num_rows, np.int64)
    rejects = reject_rows(Reason.STATE_MISFIT, time=misfits["epoch"], count=count)
    return FittingStates(states.filter(pa.array(fits)), rejects)


def _arcs(name: npt.NDArray[np.object_], epoch_ns: Indices, arc_s: float) -> Indices:
    """Return the arc of each epoch of sorted objects."""
    arc = np.zeros(len(name), np.int64)
    number, start = -1, 0
    for k, t in enumerate(epoch_ns.tolist()):
        if k == 0 or name[k] != name[k - 1] or t - start > arc_s * 1e9:
            number, start = number + 1, t
        arc[k] = number
    return arc


def _long_enough(arc: Indices, kept: Flags, minimum: int) -> Flags:
    count = np.bincount(arc, kept, minlength=1)
    return count[arc] >= minimum if len(arc) else np.zeros(0, bool)


def _starts(groups: ViewGroups, named: _NamedArcs) -> Array:
    """Return initial states: the position at each arc's middle, and the slope of the positions."""
    solved = named.solved
    name, epoch_ns = groups.object_id[solved], groups.epoch_ns[solved]
    x_km = groups.x_km[solved]
    sigma_km, time_s = np.sqrt(traces(groups.cov_km2[solved])), (epoch_ns - epoch_ns[0]) / 1e9
    v_km_s, _ = velocities(group_offsets(name), time_s, x_km, SLOPE_S, sigma_km)
    at = dict(zip(zip(name, epoch_ns.tolist(), strict=True), range(len(name)), strict=True))
    middles = zip(named.object_id, named.middle_ns.tolist(), strict=True)
    chosen = [at[middle] for middle in middles]
    return np.hstack([x_km[chosen], v_km_s[chosen]])


def _state_table(
    named: _NamedArcs, orbits: FittedOrbits, counts: Mapping[str, Indices]
) -> pa.Table:
    """Return STATES of the arcs, in order of time."""
    object_id, epoch_ns = named.object_id, named.middle_ns
    state, cov, chi2 = orbits.state, orbits.cov, orbits.chi2
    order = np.lexsort((object_id.astype(str), epoch_ns))
    columns = {
        "epoch": epoch_ns,
        "object_id": object_id,
        **unstack("{}_km", state[:, :3]),
        **unstack("v{}_km_s", state[:, 3:]),
        **unstack_covariance("cov_{}", cov, STATE_AXES),
        **{name: count.astype(np.int32) for name, count in counts.items()},
        "dof": (2 * counts["n_views"] - 6).astype(np.int32),
        "chi2": chi2,
    }
    return table(STATES, {name: values[order] for name, values in columns.items()})

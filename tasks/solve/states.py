"""Fit states: position and velocity of each object, arc by arc."""

import itertools
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc
from scipy.special import chdtrc

from epipole.schemas.bridge import (
    array,
    empty,
    stack,
    stack_covariance,
    table,
    to_polars,
    unstack,
    unstack_covariance,
)
from epipole.schemas.columns import STATE_AXES, TANGENT_AXES
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.settings import Settings
from epipole.schemas.tables import STATES
from epipole.schemas.work_tables import SHARED_ERRORS, VIEWS
from epipole.tasks.algorithms.orbits.object_motion import velocities
from epipole.tasks.algorithms.orbits.orbit_fit import Arcs, FittedOrbits, fit_orbits, prior_of
from epipole.tasks.algorithms.orbits.shared_errors import ArcEquations, scale_shared_errors
from epipole.tasks.common.grouping import group_offsets

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

MIN_PROBABLE = 1e-6  # a chi-square less probable than this does not fit
# Chi-square per degree of freedom, over that of most arcs, above which an arc mixes objects.
MIXED = 3.0
SLOPE_S = 60.0  # positions within this time of an arc's middle give the initial velocity


def fit_states(
    views: pa.Table, associations: pa.Table, positions: pa.Table, settings: Settings
) -> pa.Table:
    """Return a state for each object and arc, at the arc's middle epoch.

    Only the epochs of `independent` positions are used: these share no detection. Each
    sensor's common error is estimated together with the state.
    """
    rows = _used_views(views, associations, positions, settings)
    if not len(rows):
        return table(STATES, {name: [] for name in STATES.names})
    named = _arcs_of(rows)
    fitted = fit_orbits(named.arcs, _starts(positions, named.object_id, named.middle_ns))
    counts = {"n_epochs": named.n_epochs, "n_views": np.diff(named.arcs.offsets)}
    return _state_table(named.object_id, named.middle_ns, fitted, counts)


def judge_errors(
    views: pa.Table, associations: pa.Table, positions: pa.Table, settings: Settings
) -> pa.Table:
    """Return SHARED_ERRORS: the sensors whose shared errors are larger than stated.

    All objects together show whether the errors that a sensor's views share are of the stated
    size; see `scale_shared_errors`.
    """
    rows = _used_views(views, associations, positions, settings)
    if not len(rows):
        return empty(SHARED_ERRORS)
    named = _arcs_of(rows)
    arcs = named.arcs
    fitted = fit_orbits(arcs, _starts(positions, named.object_id, named.middle_ns))
    sensors = rows.group_by("sensor").agg(pl.col("sensor_id").first()).sort("sensor")["sensor_id"]
    prior = prior_of(arcs, slice(None), arcs.sensor, len(sensors))
    has_bias = np.bincount(arcs.sensor, np.trace(arcs.cov_bias, axis1=1, axis2=2)) > 0.0
    free = np.column_stack([has_bias, np.ones(len(sensors), bool)])
    telling = _of_one_object(fitted, np.diff(arcs.offsets))
    factor = scale_shared_errors(telling, prior, free)
    larger = np.flatnonzero((factor > 1.0).any(axis=1))
    return table(
        SHARED_ERRORS,
        {
            "sensor_id": sensors.to_numpy()[larger],
            "direction": factor[larger, 0],
            "place": factor[larger, 1],
        },
    )


def with_larger_errors(views: pa.Table, errors: pa.Table) -> pa.Table:
    """Return VIEWS with the shared errors of some sensors as large as SHARED_ERRORS say."""
    return _scaled(views, errors, 1.0)


def with_stated_errors(views: pa.Table, errors: pa.Table) -> pa.Table:
    """Return VIEWS with the shared errors as the sensors state them: undo `with_larger_errors`."""
    return _scaled(views, errors, -1.0)


def _scaled(views: pa.Table, errors: pa.Table, power: float) -> pa.Table:
    if not errors.num_rows:
        return views
    row = pc.index_in(views["sensor_id"], errors["sensor_id"].combine_chunks())
    direction, place = (
        pc.fill_null(errors[name].take(row), 1.0).to_numpy() ** power
        for name in ("direction", "place")
    )
    bias = stack_covariance(views, "cov_bias_{}_rad2", TANGENT_AXES) * direction[:, None, None]
    columns = {name: views[name] for name in VIEWS.names} | {
        **unstack_covariance("cov_bias_{}_rad2", bias, TANGENT_AXES),
        "position_sigma_km": array(views, "position_sigma_km") * np.sqrt(place),
    }
    return table(VIEWS, columns)


def _of_one_object(fitted: FittedOrbits, n_views: Indices) -> list[tuple[Indices, ArcEquations]]:
    """Return the equations of the arcs that do not mix objects."""
    reduced = fitted.chi2 / np.maximum(2 * n_views - 6, 1)
    # A sensor with a large error makes all arcs fit badly, a mixture one.
    usual = max(1.0, float(np.nanmedian(reduced))) if np.isfinite(reduced).any() else 1.0
    return [fitted.equations[k] for k in np.flatnonzero(reduced < MIXED * usual)]


class _NamedArcs(NamedTuple):
    """Arcs, each with its object, middle epoch and number of epochs."""

    arcs: Arcs
    object_id: npt.NDArray[np.object_]
    middle_ns: Indices
    n_epochs: Indices


def _arcs_of(rows: pl.DataFrame) -> _NamedArcs:
    """Return the arcs of views that are sorted by arc and epoch."""
    arc = rows["arc"].to_numpy()
    offsets = group_offsets(arc)
    epoch_ns = rows["epoch"].cast(pl.Int64).to_numpy()
    epochs = [np.unique(epoch_ns[lo:hi]) for lo, hi in itertools.pairwise(offsets)]
    n_epochs = np.array([len(of_arc) for of_arc in epochs])
    middle = np.array([of_arc[len(of_arc) // 2] for of_arc in epochs])
    object_id = rows["object_id"].to_numpy()[offsets[:-1]]
    arcs = Arcs(
        offsets=offsets,
        time_s=(epoch_ns - np.repeat(middle, np.diff(offsets))) / 1e9,
        sensor=rows["sensor"].to_numpy().astype(np.int64),
        r_km=stack(rows, "{}_km"),
        u=stack(rows, "u{}"),
        cov_noise=stack_covariance(rows, "cov_noise_{}_rad2", TANGENT_AXES),
        cov_bias=stack_covariance(rows, "cov_bias_{}_rad2", TANGENT_AXES),
        sigma_km=rows["position_sigma_km"].to_numpy(),
    )
    return _NamedArcs(arcs, object_id, middle, n_epochs)


class FittingStates(NamedTuple):
    """STATES whose chi-square fits, and rows of `rejects` for the others."""

    states: pa.Table
    rejects: pa.Table


def refuse_misfits(states: pa.Table) -> FittingStates:
    """Return the states whose chi-square fits their degrees of freedom.

    Any other state mixes two objects, or the errors of its views are larger than stated. Its
    covariance is not valid.
    """
    fits = chdtrc(array(states, "dof"), array(states, "chi2")) > MIN_PROBABLE
    misfits = states.filter(pa.array(~fits)).sort_by("epoch")
    count = np.ones(misfits.num_rows, np.int64)
    rejects = reject_rows(Reason.STATE_MISFIT, time=misfits["epoch"], count=count)
    return FittingStates(states.filter(pa.array(fits)), rejects)


def _used_views(
    views: pa.Table, associations: pa.Table, positions: pa.Table, settings: Settings
) -> pl.DataFrame:
    """Return the views used for independent positions, with their arc numbers."""
    key = ["epoch", "sensor_id", "frame_number", "x_px", "y_px"]
    solved = to_polars(positions).select("epoch", "object_id", "independent")
    solved = solved.sort("object_id", "epoch")
    name, kept = solved["object_id"].to_numpy(), solved["independent"].to_numpy()
    arc = _arcs(name, solved["epoch"].cast(pl.Int64).to_numpy(), settings.states.arc_s)
    arc = np.where(_long_enough(arc, kept, settings.states.min_epochs), arc, -1)
    solved = solved.with_columns(arc=arc).filter(pl.Series(kept & (arc >= 0)))
    # Few epochs are independent: the others need no look.
    epochs = np.unique(solved["epoch"].cast(pl.Int64).to_numpy())
    seen, claims = (
        to_polars(rows.take(np.flatnonzero(np.isin(array(rows, "epoch"), epochs))))
        for rows in (views, associations.select([*key, "object_id", "used"]))
    )
    return (
        seen.join(claims.filter("used").select([*key, "object_id"]), on=key)
        .join(solved, on=["epoch", "object_id"])
        .with_columns(sensor=pl.col("sensor_id").rank("dense").cast(pl.Int64) - 1)
        .sort("arc", "epoch", "sensor")
    )


def _arcs(name: npt.NDArray[np.object_], epoch_ns: Indices, arc_s: float) -> Indices:
    """Return the arc of each epoch of sorted objects."""
    arc = np.zeros(len(name), np.int64)
    number, begun = -1, 0
    for k, t in enumerate(epoch_ns.tolist()):
        if k == 0 or name[k] != name[k - 1] or t - begun > arc_s * 1e9:
            number, begun = number + 1, t
        arc[k] = number
    return arc


def _long_enough(arc: Indices, kept: npt.NDArray[np.bool_], least: int) -> npt.NDArray[np.bool_]:
    count = np.bincount(arc, kept, minlength=1)
    return count[arc] >= least if len(arc) else np.zeros(0, bool)


def _starts(positions: pa.Table, object_id: npt.NDArray[np.object_], middle_ns: Indices) -> Array:
    """Return initial states: the position at each arc's middle, and the slope there."""
    rows = to_polars(positions).sort("object_id", "epoch")
    name, epoch_ns = rows["object_id"].to_numpy(), rows["epoch"].cast(pl.Int64).to_numpy()
    offsets = group_offsets(name)
    x_km = stack(rows, "{}_km")
    v_km_s, _ = velocities(offsets, (epoch_ns - epoch_ns[0]) / 1e9, x_km, SLOPE_S)
    at = dict(zip(zip(name, epoch_ns.tolist(), strict=True), range(len(name)), strict=True))
    chosen = [at[key] for key in zip(object_id, middle_ns.tolist(), strict=True)]
    return np.hstack([x_km[chosen], v_km_s[chosen]])


def _state_table(
    object_id: npt.NDArray[np.object_],
    epoch_ns: Indices,
    orbits: FittedOrbits,
    counts: Mapping[str, Indices],
) -> pa.Table:
    """Return STATES of the arcs whose fit converged, in order of time."""
    state, cov, chi2 = orbits.state, orbits.cov, orbits.chi2
    fitted = np.flatnonzero(np.isfinite(chi2))
    fitted = fitted[np.lexsort((object_id[fitted].astype(str), epoch_ns[fitted]))]
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
    return table(STATES, {name: values[fitted] for name, values in columns.items()})

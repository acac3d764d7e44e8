"""Solve positions: each object at each epoch, by weighted least squares over all its views."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import (
    array,
    concat,
    stack,
    stack_covariance,
    table,
    unstack,
    unstack_covariance,
)
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.settings import Settings
from epipole.schemas.spans import Span
from epipole.schemas.tables import POSITIONS, REJECTS
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.triangulation import triangulate
from epipole.tasks.algorithms.orbits.object_motion import (
    keep_independent,
    neglected_motion,
    velocities,
)
from epipole.tasks.common.grouping import factorize, group_offsets
from epipole.tasks.common.sightings import only_id
from epipole.tasks.solve.pairs import ViewGroups, association_table, pair_table

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

VELOCITY_WINDOW_S = 30.0  # positions within this time give an object's velocity


class Solved(NamedTuple):
    """Tables ASSOCIATIONS, PAIRS, POSITIONS and REJECTS.

    `views` are VIEWS of the objects. Where an object's motion is known, their directions are
    corrected for the motion that their fits neglected.
    """

    associations: pa.Table
    pairs: pa.Table
    positions: pa.Table
    rejects: pa.Table
    views: pa.Table


def solve_positions(
    views: pa.Table, object_number: Indices, settings: Settings, span: Span | None = None
) -> Solved:
    """Return the positions, with covariances, of objects that two or more sensors detect.

    They are solved twice. The first solution gives the velocities, which are needed because the
    light time to near and far sensors differs, and for the motion that the fits of the directions
    neglected. With `span`, only its epochs are returned.
    """
    groups = _solve(views, object_number, settings)
    if span is not None:
        groups = _within(groups, span)
    groups = groups._replace(independent=_independent(groups, span))
    return Solved(
        association_table(groups),
        pair_table(groups, settings),
        _position_table(groups),
        _reject_table(groups),
        groups.views,
    )


def _solve(views: pa.Table, object_number: Indices, settings: Settings) -> ViewGroups:
    views, number = _in_order(views, object_number)
    epoch_ns = array(views, "epoch")
    offsets = group_offsets(epoch_ns, number)
    r_km, sigma_km = stack(views, "{}_km"), array(views, "position_sigma_km")
    start = offsets[:-1]
    velocity = np.zeros((len(start), 3))
    for last in (False, True):
        u, cov = stack(views, "u{}"), _direction_covariance(views)
        x_km, cov_km2, chi2, used, mean_range = triangulate(
            offsets, r_km, u, cov, sigma_km, velocity, settings.positions.reject_sigma
        )
        velocity, spread_s = _velocities(epoch_ns[start], number[start], x_km)
        if not last:
            group = np.repeat(np.arange(len(start)), np.diff(offsets))
            sigma = np.sqrt(np.trace(cov_km2, axis1=1, axis2=2) / 3)
            views = with_neglected_motion(
                views,
                np.hstack([x_km, velocity])[group],
                sigma[group],
                spread_s[group],
            )
    return ViewGroups(
        views, offsets, object_names(epoch_ns[start], number[start]), epoch_ns[start], u, r_km, cov,
        x_km, cov_km2, chi2, used, mean_range, velocity, np.zeros(len(start), bool),
    )  # fmt: skip


def _in_order(views: pa.Table, number: Indices) -> tuple[pa.Table, Indices]:
    """Return the views in the order of epochs, objects and sensors."""
    order = np.lexsort((factorize(views, "sensor_id").rank, number, array(views, "epoch")))
    if np.array_equal(order, np.arange(len(order))):
        return views, number
    return views.take(order), number[order]


def with_neglected_motion(
    views: pa.Table, state: Array, sigma_km: Array, spread_s: Array
) -> pa.Table:
    """Return VIEWS with directions corrected for the motion that their fits neglected.

    Parameters
    ----------
    state : (n, 6) float
        Position and velocity of each view's object; NaN where unknown.
    sigma_km, spread_s : (n,) float
        1-sigma error of the position, and the `spread_s` of the velocity.

    Notes
    -----
    The error of the correction takes the place of the variance of the neglected motion. A view
    for which it is not smaller stays as it is.
    """
    sensor = np.hstack([stack(views, "{}_km"), stack(views, "sensor_v{}_km_s")])
    moments, neglected = stack(views, "moment_{}", "123"), array(views, "unmodelled_rad2")
    off = neglected_motion(state, sensor, moments)
    reach = np.linalg.norm(state[:, :3] - sensor[:, :3], axis=1)
    speed = np.linalg.norm(state[:, 3:] - sensor[:, 3:], axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        error = sigma_km / (spread_s * reach) * (
            np.abs(moments[:, 0]) + np.abs(moments[:, 1]) * speed / reach
        )  # fmt: skip
        error = np.hypot(error, np.linalg.norm(off, axis=1) * sigma_km / reach)
    known = error**2 < neglected
    off[~known] = 0.0
    u = stack(views, "u{}") - off
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    less = np.where(known, neglected - error**2, 0.0)
    cov = stack_covariance(views, "cov_noise_{}_rad2", TANGENT_AXES)
    cov = cov - less[:, None, None] * np.eye(2)
    columns = {
        **unstack("u{}", u),
        **unstack_covariance("cov_noise_{}_rad2", cov, TANGENT_AXES),
        "unmodelled_rad2": neglected - less,
    }
    return table(VIEWS, {**{name: views[name] for name in VIEWS.names}, **columns})


def _within(groups: ViewGroups, span: Span) -> ViewGroups:
    """Return the groups whose epoch lies in a span."""
    kept = span.holds(groups.epoch_ns)
    if kept.all():
        return groups
    rows = np.flatnonzero(kept[groups.group])
    size = np.diff(groups.offsets)[kept]
    return ViewGroups(
        views=groups.views.take(rows),
        offsets=np.concatenate([[0], np.cumsum(size)]).astype(np.int64),
        object_id=groups.object_id[kept],
        epoch_ns=groups.epoch_ns[kept],
        u=groups.u[rows],
        r_km=groups.r_km[rows],
        cov=groups.cov[rows],
        x_km=groups.x_km[kept],
        cov_km2=groups.cov_km2[kept],
        chi2=groups.chi2[kept],
        used=groups.used[rows],
        mean_range_km=groups.mean_range_km[kept],
        velocity_km_s=groups.velocity_km_s[kept],
        independent=groups.independent[kept],
    )


def _independent(groups: ViewGroups, span: Span | None) -> npt.NDArray[np.bool_]:
    """Return the groups to use where no two may share a detection: in order of time, each that
    shares none with those before.

    Where a detection lies outside the span, the neighbouring span may use it: not such a group.
    """
    first_ns, last_ns = array(groups.views, "first_fitted"), array(groups.views, "last_fitted")
    apart = np.isfinite(groups.chi2)
    if span is not None:
        outside = ~(span.holds(first_ns) & span.holds(last_ns))
        apart[groups.group[outside & groups.used]] = False
    track, names = factorize(groups.views, "tracklet_id")
    until = np.full(len(names), np.iinfo(np.int64).min)
    # Copies: to numba a read-only array is another type.
    keep_independent(
        groups.offsets, groups.used, track, first_ns.copy(), last_ns.copy(), until, apart
    )
    return apart


def object_names(epoch_ns: Indices, number: Indices) -> npt.NDArray[np.object_]:
    """Return an id for each object: the UTC date of its first epoch, and its number.

    Rows are in order of time.
    """
    names = np.empty(len(number), dtype=object)
    first: dict[int, str] = {}
    for i, (t, n) in enumerate(zip(epoch_ns.tolist(), number.tolist(), strict=True)):
        if n not in first:
            date = np.datetime64(t, "ns").astype("datetime64[D]")
            first[n] = f"{str(date).replace('-', '')}-{n + 1:05d}"
        names[i] = first[n]
    return names


def _direction_covariance(views: pa.Table) -> Array:
    noise, bias = (
        stack_covariance(views, f"cov_{which}_{{}}_rad2", TANGENT_AXES)
        for which in ("noise", "bias")
    )
    return noise + bias


def _velocities(epoch_ns: Indices, number: Indices, x_km: Array) -> tuple[Array, Array]:
    order = np.lexsort((epoch_ns, number))
    cuts = np.flatnonzero(np.diff(number[order])) + 1
    offsets = np.concatenate([[0], cuts, [len(number)]]).astype(np.int64)
    v_km_s, spread_s = np.empty_like(x_km), np.empty(len(x_km))
    origin = epoch_ns[0] if len(epoch_ns) else 0
    time_s = (epoch_ns[order] - origin) / 1e9
    v_km_s[order], spread_s[order] = velocities(offsets, time_s, x_km[order], VELOCITY_WINDOW_S)
    return v_km_s, spread_s


def _position_table(groups: ViewGroups) -> pa.Table:
    solved = np.isfinite(groups.chi2)
    n_used = np.bincount(groups.group, groups.used, minlength=len(solved)).astype(np.int32)
    light_ns = np.nan_to_num(groups.mean_range_km / SPEED_OF_LIGHT_KM_S * 1e9)
    columns = {
        "epoch": groups.epoch_ns,
        "time": groups.epoch_ns - np.round(light_ns).astype(np.int64),
        "object_id": groups.object_id,
        **unstack("{}_km", groups.x_km),
        **unstack_covariance("cov_{}", groups.cov_km2),
        "n_sensors": n_used,
        "n_rejected": np.diff(groups.offsets).astype(np.int32) - n_used,
        "residual_px": _residual_px(groups),
        "chi2": groups.chi2,
        "independent": groups.independent,
    }
    return table(POSITIONS, {name: values[solved] for name, values in columns.items()})


def _residual_px(groups: ViewGroups) -> Array:
    """Return the rms image distance of each group's used views from its position."""
    sight = groups.apparent_km - groups.r_km
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    pixel = array(groups.views, "pixel_rad")
    square = np.where(groups.used, np.sum((sight - groups.u) ** 2, axis=1) / pixel**2, 0.0)
    size = len(groups.epoch_ns)
    count = np.maximum(np.bincount(groups.group, groups.used, minlength=size), 1)
    return np.sqrt(np.bincount(groups.group, square, minlength=size) / count)


def _reject_table(groups: ViewGroups) -> pa.Table:
    """Return a row of `rejects` per sensor and reason, with the number of views."""
    unsolved = ~np.isfinite(groups.chi2)[groups.group]
    which = {
        Reason.VIEW_REJECTED: ~groups.used & ~unsolved,
        Reason.NO_POSITION: unsolved,
    }
    sensor, names = factorize(groups.views, "sensor_id")
    tracklet_id = array(groups.views, "tracklet_id")
    epoch_ns = array(groups.views, "epoch")
    tables = []
    for reason, left_out in which.items():
        for k in np.unique(sensor[left_out]):
            rows = left_out & (sensor == k)
            tables.append(
                reject_rows(
                    reason,
                    sensor_id=str(names[k]),
                    tracklet_id=only_id(tracklet_id[rows]),
                    time=[int(epoch_ns[rows].min())],
                    count=[int(rows.sum())],
                )
            )
    return concat(REJECTS, tables)

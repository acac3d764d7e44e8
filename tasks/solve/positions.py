"""Solve positions: each object at each epoch, by weighted least squares over all its views."""

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.schemas.bridge import array, concat, table, unstack, unstack_covariance
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.spans import Span
from epipole.schemas.tables import POSITIONS, REJECTS
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.covariances import traces
from epipole.tasks.algorithms.geometry.directions import lengths
from epipole.tasks.algorithms.geometry.moved_planes import on_moved_plane
from epipole.tasks.algorithms.geometry.triangulation import triangulate
from epipole.tasks.algorithms.orbits.object_motion import (
    keep_independent,
    neglected_motion,
    velocities,
)
from epipole.tasks.algorithms.orbits.platforms import views_from_one_position
from epipole.tasks.common.grouping import group_offsets
from epipole.tasks.common.sightings import only_id
from epipole.tasks.solve.view_groups import ObjectViews, ViewGroups

VELOCITY_WINDOW_S = 30.0  # positions within this time give an object's velocity
ORBITAL_KM_S = 5.0  # 1-sigma of a velocity per axis, where nothing is known of it


def solve_positions(
    views: ObjectViews, reject_sigma: float, span: Span | None = None
) -> ViewGroups:
    """Return the positions, with covariances, of objects that two or more sensors detect.

    They are solved three times. Each solution gives the velocities: by its positions, or by the
    rates of the directions where there is a single one. The next one needs them because the light
    times to the sensors differ, and the last one also because the fits of the directions neglected
    a part of the motion. The first one rejects no view: without velocities, light times put right
    ones 30 sigma off.

    Parameters
    ----------
    reject_sigma
        A view farther from the position than this is rejected, see `triangulate`.
    span
        Only its epochs are returned. Default: all.
    """
    groups = _solve(views, reject_sigma)
    if span is not None:
        groups = groups.within(span.holds(groups.epoch_ns))
    return groups._replace(independent=_independent(groups, span))


def _solve(views: ObjectViews, reject_sigma: float) -> ViewGroups:
    row = np.lexsort((views.sensor, views.object_number, views.epoch_ns))
    if not np.array_equal(row, np.arange(len(row))):
        views = views.take(row)
    offsets = group_offsets(views.epoch_ns, views.object_number)
    start = offsets[:-1]
    epoch_ns, number = views.epoch_ns[start], views.object_number[start]
    group = np.repeat(np.arange(len(start)), np.diff(offsets))
    velocity = np.zeros((len(start), 3))
    position_km = shared_position_sigmas(offsets, views)
    for step in range(3):
        limit = reject_sigma if step else np.inf
        x_km, cov_km2, chi2, used, mean_range = triangulate(
            offsets, views.r_km, views.u, views.cov, position_km, velocity, limit
        )
        sigma = np.sqrt(traces(cov_km2) / 3)
        velocity, spread_s = _velocities(epoch_ns, number, x_km, sigma)
        alone = (spread_s == 0.0) & np.isfinite(chi2)
        if alone.any():
            velocity[alone] = _velocities_by_rates(views, group, alone, x_km, used)
        if step == 1:
            state = np.hstack([x_km, velocity])[group]
            views = with_neglected_motion(views, state, sigma[group], spread_s[group])
    return ViewGroups(
        views=views,
        row=row,
        offsets=offsets,
        object_id=object_names(epoch_ns, number),
        epoch_ns=epoch_ns,
        x_km=x_km,
        cov_km2=cov_km2,
        velocity_km_s=velocity,
        chi2=chi2,
        mean_range_km=mean_range,
        used=used,
        independent=np.zeros(len(start), bool),
    )


def shared_position_sigmas(offsets: Indices, views: ObjectViews) -> Array:
    """Return the 1-sigma errors of the sensors' positions [km] with which views of groups are
    independent: the error that n sensors of one satellite share counts once if it has n times its
    variance in each."""
    sharing = views_from_one_position(offsets, views.r_km, views.sigma_km)
    return views.sigma_km * np.sqrt(sharing)


def with_neglected_motion(
    views: ObjectViews, state: Array, sigma_km: Array, spread_s: Array
) -> ObjectViews:
    """Return views with directions corrected for the motion that their fits neglected.

    Parameters
    ----------
    state : (n, 6) float
        Position and velocity of each view's object; NaN where unknown.
    sigma_km, spread_s : (n,) float
        1-sigma error of the position, and the time spread behind the velocity, see `velocities`.

    Notes
    -----
    The variance of the correction replaces that of the neglected motion. A view for which it is not
    smaller is not changed.
    """
    sensor = np.hstack([views.r_km, views.v_km_s])
    moments, neglected = views.moments, views.unmodelled
    correction = neglected_motion(state, sensor, moments)
    range_km = lengths(state[:, :3] - sensor[:, :3])
    speed = lengths(state[:, 3:] - sensor[:, 3:])
    with np.errstate(divide="ignore", invalid="ignore"):
        error = sigma_km / (spread_s * range_km) * (
            np.abs(moments[:, 0]) + np.abs(moments[:, 1]) * speed / range_km
        )  # fmt: skip
        error = np.hypot(error, lengths(correction) * sigma_km / range_km)
    known = error**2 < neglected
    correction[~known] = 0.0
    u = views.u - correction
    u /= lengths(u)[:, None]
    removed = np.where(known, neglected - error**2, 0.0)
    cov = views.cov_noise - removed[:, None, None] * np.eye(2)
    return views._replace(
        u=u,
        cov_noise=on_moved_plane(cov, views.u, u),
        cov_bias=on_moved_plane(views.cov_bias, views.u, u),
        unmodelled=neglected - removed,
    )


def _independent(groups: ViewGroups, span: Span | None) -> Flags:
    """Return groups of which no two share a detection: in order of time, each group that shares no
    detection with those chosen before.

    Groups with a detection outside the span are left out: the neighbouring span may use it.
    """
    views, independent = groups.views, groups.solved
    if span is not None:
        outside = ~(span.holds(views.first_ns) & span.holds(views.last_ns))
        independent[groups.group[outside & groups.used]] = False
    until = np.full(int(views.tracklet.max(initial=-1)) + 1, np.iinfo(np.int64).min)
    keep_independent(
        groups.offsets,
        groups.used,
        views.tracklet,
        views.first_ns,
        views.last_ns,
        until,
        independent,
    )
    return independent


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


def _velocities(
    epoch_ns: Indices, number: Indices, x_km: Array, sigma_km: Array
) -> tuple[Array, Array]:
    order = np.lexsort((epoch_ns, number))
    cuts = np.flatnonzero(np.diff(number[order])) + 1
    offsets = np.concatenate([[0], cuts, [len(number)]]).astype(np.int64)
    v_km_s, spread_s = np.empty_like(x_km), np.empty(len(x_km))
    origin = epoch_ns[0] if len(epoch_ns) else 0
    time_s = (epoch_ns[order] - origin) / 1e9
    v_km_s[order], spread_s[order] = velocities(
        offsets, time_s, x_km[order], VELOCITY_WINDOW_S, sigma_km[order]
    )
    return v_km_s, spread_s


def _velocities_by_rates(
    views: ObjectViews, group: Indices, wanted: Flags, x_km: Array, used: Flags
) -> Array:
    """Return velocities [km/s] of the wanted groups, by the rates of their used views: (w, 3).

    Least squares: each view shows the motion across its line of sight. What none shows stays 0.
    `group` (n,) is that of each view, `wanted` (g,) bool.
    """
    known = views.w.any(axis=1) & np.isfinite(views.v_km_s).all(axis=1)
    rows = np.flatnonzero(wanted[group] & used & known)
    group = (np.cumsum(wanted) - 1)[group[rows]]
    u, range_km = views.u[rows], lengths(x_km[wanted][group] - views.r_km[rows])
    fitted_s = (views.last_ns[rows] - views.first_ns[rows]) / 1e9
    noise_rad = np.sqrt(traces(views.cov_noise[rows]) / 2)
    sigma_km_s = np.sqrt(12.0) * noise_rad * range_km / np.maximum(fitted_s, 1e-3)
    across = (np.eye(3) - u[:, :, None] * u[:, None, :]) / (sigma_km_s**2)[:, None, None]
    normal = np.tile(np.eye(3) / ORBITAL_KM_S**2, (wanted.sum(), 1, 1))
    right = np.zeros((wanted.sum(), 3))
    seen_km_s = range_km[:, None] * views.w[rows] + views.v_km_s[rows]
    np.add.at(normal, group, across)
    np.add.at(right, group, np.einsum("nij,nj->ni", across, seen_km_s))
    return np.asarray(np.linalg.solve(normal, right[:, :, None])[:, :, 0])


def position_table(groups: ViewGroups) -> pa.Table:
    """Return POSITIONS of the groups that have one."""
    solved = groups.solved
    n_used = groups.n_used.astype(np.int32)
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
    sight = groups.apparent_km - groups.views.r_km
    sight /= np.linalg.norm(sight, axis=1, keepdims=True)
    distance2 = np.sum((sight - groups.views.u) ** 2, axis=1) / groups.views.pixel_rad**2
    square = np.where(groups.used, distance2, 0.0)
    total = np.bincount(groups.group, square, minlength=len(groups.epoch_ns))
    return np.sqrt(total / np.maximum(groups.n_used, 1))


def reject_table(groups: ViewGroups) -> pa.Table:
    """Return a row of `rejects` per sensor and reason, with the number of views."""
    unsolved = ~groups.solved[groups.group]
    which = {
        Reason.VIEW_REJECTED: ~groups.used & ~unsolved,
        Reason.NO_POSITION: unsolved,
    }
    views = groups.views
    tracklet_id = array(views.labels, "tracklet_id")
    tables = []
    for reason, left_out in which.items():
        for k in np.unique(views.sensor[left_out]):
            rows = left_out & (views.sensor == k)
            tables.append(
                reject_rows(
                    reason,
                    sensor_id=str(views.sensor_ids[k]),
                    tracklet_id=only_id(tracklet_id[rows]),
                    time=[int(views.epoch_ns[rows].min())],
                    count=[int(rows.sum())],
                )
            )
    return concat(REJECTS, tables)

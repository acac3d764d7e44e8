"""Pair views: how far the views of an object at an epoch lie from each other's epipolar lines."""

import numpy as np
import pyarrow as pa

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.schemas.bridge import table
from epipole.schemas.tables import ASSOCIATIONS, PAIRS
from epipole.tasks.algorithms.geometry.covariances import traces
from epipole.tasks.algorithms.geometry.directions import lengths
from epipole.tasks.algorithms.geometry.epipolar import (
    UncertainSight,
    epipolar_angle,
    epipolar_rms,
    epipolar_sigma,
)
from epipole.tasks.common.sightings import published_ids
from epipole.tasks.solve.view_groups import ViewGroups

MAX_OTHERS = 8  # views from which a view's epipolar distance is taken: those of least error


def association_table(groups: ViewGroups) -> pa.Table:
    """Return ASSOCIATIONS: a row per view."""
    views, labels = groups.views, groups.views.labels
    ranked = np.lexsort((_position_error(groups), groups.group))
    angle = epipolar_rms(groups.offsets, ranked, MAX_OTHERS, _seen_together(groups), views.u)
    shared = ("epoch", "sensor_id", "frame_number", "centroid", "x_px", "y_px")
    return table(
        ASSOCIATIONS,
        {name: labels[name] for name in shared}
        | {
            "tracklet_id": published_ids(labels["tracklet_id"]),
            "object_id": groups.object_id[groups.group],
            "epipolar_px": angle / views.pixel_rad,
            "used": groups.used,
        },
    )


def pair_table(groups: ViewGroups, all_pairs: bool) -> pa.Table:
    """Return PAIRS: used views that both have a centroid, the reference view first.

    The reference view is the one of the least position error. With `all_pairs`, every two views.
    """
    has_centroid = groups.views.labels["centroid"].is_valid().to_numpy() & groups.used
    if all_pairs:
        first, second = _every_two(groups.group, has_centroid)
    else:
        first, second = _with_reference(groups, has_centroid)
    epipolar_px, mahalanobis = _distances(groups, first, second)
    columns = {
        "epoch": groups.epoch_ns[groups.group[first]],
        "epipolar_px": epipolar_px,
        "mahalanobis": mahalanobis,
    }
    for side, rows in (("1", first), ("2", second)):
        for name in ("sensor_id", "frame_number", "centroid"):
            columns[f"{name}_{side}"] = groups.views.labels[name].take(rows)
    return table(PAIRS, columns)


def _seen_together(groups: ViewGroups) -> Array:
    """Return the positions of the sensors, each moved as if all saw the object at one position:
    the light to a farther one left earlier."""
    return groups.views.r_km + np.nan_to_num(groups.x_km[groups.group] - groups.apparent_km)


def _position_error(groups: ViewGroups) -> Array:
    """Return the square of the error that each view alone leaves at the object [km^2]."""
    views = groups.views
    across = traces(views.cov) / 2
    range_km = lengths(groups.x_km[groups.group] - views.r_km)
    return across * range_km**2 + views.sigma_km**2


def _with_reference(groups: ViewGroups, candidates: Flags) -> tuple[Indices, Indices]:
    """Return each candidate's reference view, and the candidate."""
    error = np.where(candidates, _position_error(groups), np.inf)
    least = np.flatnonzero(error == np.fmin.reduceat(error, groups.offsets[:-1])[groups.group])
    first_least = least[np.searchsorted(least, groups.offsets[:-1])]
    reference = first_least[groups.group]
    second = np.flatnonzero(candidates & (reference != np.arange(len(reference))))
    return reference[second], second


def _every_two(group: Indices, candidates: Flags) -> tuple[Indices, Indices]:
    """Return every two candidates of a group; their number grows with the square of the views."""
    rows = np.flatnonzero(candidates)
    pairs = [np.zeros((0, 2), np.int64)]
    step = 1
    while step < len(rows):
        same = np.flatnonzero(group[rows[step:]] == group[rows[:-step]])
        if not len(same):
            break
        pairs.append(np.column_stack([rows[same], rows[same + step]]))
        step += 1
    first, second = np.concatenate(pairs).T
    order = np.lexsort((second, first))
    return first[order], second[order]


def _distances(groups: ViewGroups, first: Indices, second: Indices) -> tuple[Array, Array]:
    """Return how far each second view lies from the first one's epipolar line: in px, in sigmas."""
    views = groups.views
    r, u = _seen_together(groups), views.u
    angle = np.abs(epipolar_angle(r[first], u[first], r[second], u[second]))
    one, two = (
        UncertainSight(r[rows], u[rows], views.cov[rows], views.sigma_km[rows])
        for rows in (first, second)
    )
    sigma = epipolar_sigma(one, two, groups.x_km[groups.group[first]])
    return angle / views.pixel_rad[second], angle / sigma

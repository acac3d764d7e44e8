"""Associate objects: which tracklets of different sensors are one object, window by window."""

import logging
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import concat
from epipole.schemas.methods import ASSOCIATION, load_method
from epipole.schemas.rejects import Outcome, Reason, reject_rows
from epipole.schemas.settings import Settings
from epipole.schemas.tables import REJECTS
from epipole.tasks.algorithms.association.sampling.samples import Groups, Samples
from epipole.tasks.algorithms.association.verdicts import Verdicts
from epipole.tasks.algorithms.orbits.object_identity import ObjectRegistry
from epipole.tasks.algorithms.sensor_faults.agreement import agreement
from epipole.tasks.common.lone_detections import only_id
from epipole.tasks.solve.sample_views import SpanViews

LOGGER = logging.getLogger(__name__)

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

LONGER_S = (120.0, 600.0)  # each divides a span


class Associated(NamedTuple):
    """Views of objects, each with the number of its object; and rows of `rejects`.

    `undecided` has a row (epoch, tracklet_id, outcome) for each view whose tracklet is ambiguous or
    whose sensor was left out at that time.
    """

    views: pa.Table
    object_number: Indices
    rejects: pa.Table
    undecided: pa.Table


def associate_objects(
    views: pa.Table,
    tracklets: pa.Table,
    solutions: pa.Table,
    cameras: pa.Table,
    settings: Settings,
) -> Associated:
    """Return the views of objects that two or more sensors detect, and the object of each.

    Object numbers count from 0 in the order of first appearance. An object keeps its number from
    window to window as long as one of its tracks continues. A sensor that disagrees with all
    others is left out.
    """
    views = views.sort_by([("epoch", "ascending"), ("sensor_id", "ascending"),
                           ("tracklet_id", "ascending")])  # fmt: skip
    arrays = SpanViews(views, tracklets, solutions, cameras)
    windows = arrays.windows(settings.association.span_s)
    verdicts = Verdicts(arrays.keys(windows))
    believed = np.ones(views.num_rows, bool)
    rejects = []
    for rows in windows:
        disagreeing = _judge(arrays, rows, verdicts, settings)
        if len(disagreeing):
            left_out = rows[np.isin(arrays.sensor[rows], disagreeing)]
            believed[left_out] = False
            rejects.append(_reject_table(arrays, Reason.SENSOR_DISAGREES, rows, left_out))
    if settings.association.method == "likelihood":
        _judge_again(arrays, verdicts, believed, settings)
    number = _numbered(arrays, verdicts.group, windows)
    for rows in windows:
        ambiguous = rows[verdicts.ambiguous[rows]]
        if len(ambiguous):
            rejects.append(_reject_table(arrays, Reason.AMBIGUOUS, rows, ambiguous))
    _warn_of(arrays.sensors[np.unique(arrays.sensor[~believed])])
    number = _with_two_sensors(arrays, number)
    chosen = np.flatnonzero(number >= 0)
    return Associated(
        views.take(chosen),
        number[chosen],
        concat(REJECTS, rejects),
        _undecided(views, believed, verdicts.ambiguous),
    )


def _judge(arrays: SpanViews, rows: Indices, verdicts: Verdicts, settings: Settings) -> Indices:
    """Enter the verdict on a window's views; return the sensors that disagree with all others.

    If there are any, the other sensors are judged again without them.
    """
    groups, samples, tracklet = _grouped(arrays, rows, settings)
    disagreeing = agreement(samples, groups).disagreeing()
    if len(disagreeing):
        rows = rows[~np.isin(arrays.sensor[rows], disagreeing)]
        if not len(rows):
            return disagreeing
        groups, samples, tracklet = _grouped(arrays, rows, settings)
    verdicts.enter(rows, tracklet, groups)
    return disagreeing


def _grouped(
    arrays: SpanViews, rows: Indices, settings: Settings
) -> tuple[Groups, Samples, Indices]:
    """Return the groups of a window's tracklets, their samples and the tracklets' numbers."""
    instants = arrays.instants(rows, settings.alignment.window_s)
    samples, tracklet = arrays.samples(rows, instants, settings.alignment.window_s)
    return _solve(arrays, samples, settings), samples, tracklet


def _warn_of(sensors: npt.NDArray[np.str_]) -> None:
    if len(sensors):
        LOGGER.warning(
            "%s: lines of sight agree with no other sensor's (wrong clock, position or "
            "attitude?); left out at these times", ", ".join(sorted(sensors.tolist())),
        )  # fmt: skip


def _undecided(
    views: pa.Table, believed: npt.NDArray[np.bool_], ambiguous: npt.NDArray[np.bool_]
) -> pa.Table:
    outcome = np.where(believed, Outcome.AMBIGUOUS, Outcome.SENSOR_LEFT_OUT).astype(object)
    rows = views.select(["epoch", "tracklet_id"]).append_column(
        "outcome", pa.array(outcome.tolist(), pa.string())
    )
    return rows.filter(pa.array(ambiguous | ~believed))


def _judge_again(
    arrays: SpanViews, verdicts: Verdicts, believed: npt.NDArray[np.bool_], settings: Settings
) -> None:
    """Judge undecided tracklets again, over longer windows."""
    judged_s = settings.association.span_s
    for window_s in LONGER_S:
        if not judged_s < window_s <= settings.association.longest_span_s:
            continue
        for window in arrays.windows(window_s):
            rows = window[believed[window]]
            open_rows = verdicts.open_rows(rows, judged_s)
            if len(open_rows):
                instants = arrays.even_instants(rows, settings.alignment.window_s)
                samples, tracklet = arrays.samples(rows, instants, settings.alignment.window_s)
                groups = _solve(arrays, samples, settings)
                verdicts.reconsider(rows, open_rows, tracklet, groups)
        judged_s = window_s


def _numbered(arrays: SpanViews, group: Indices, windows: list[Indices]) -> Indices:
    """Return each view's object number: groups that share a track are one object."""
    registry = ObjectRegistry(np.bincount(arrays.track[arrays.tracklet]).astype(float))
    number = np.full(len(group), -1)
    for rows in windows:
        grouped = rows[group[rows] >= 0]
        groups, of_row = np.unique(group[grouped], return_inverse=True)
        objects = registry.name_groups(
            [
                np.unique(arrays.track[arrays.tracklet[grouped[of_row == g]]])
                for g in range(len(groups))
            ]
        )
        number[grouped] = np.array(objects, np.int64)[of_row]
    return number


def _solve(arrays: SpanViews, samples: Samples, settings: Settings) -> Groups:
    associate = load_method(ASSOCIATION, settings.association.method)
    groups: Groups = associate(samples, arrays.focal_px, settings.association)
    return groups


def _reject_table(
    arrays: SpanViews, reason: Reason, window: Indices, left_out: Indices
) -> pa.Table:
    """Return a row of `rejects` per sensor: how many of its tracklets are left out in a window.

    Parameters
    ----------
    window, left_out
        Rows of the views of the window, and of the views that are left out.
    """
    tracklet = np.unique(arrays.tracklet[left_out])
    sensor = arrays.sensor_of_tracklet[tracklet]
    sensors, count = np.unique(sensor, return_counts=True)
    return reject_rows(
        reason,
        sensor_id=arrays.sensors[sensors],
        tracklet_id=[only_id(arrays.tracklet_id[tracklet[sensor == s]]) for s in sensors],
        time=[int(arrays.epoch_ns[window[0]])] * len(sensors),
        count=count,
    )


def _with_two_sensors(arrays: SpanViews, number: Indices) -> Indices:
    """Return the object numbers; -1 where no second sensor has a view of the object at the epoch.

    Two fragments of a track in one sensor may both have a view of an object at an epoch. Only one
    counts: the one with a centroid in the frame, or else the first.
    """
    kept = number.copy()
    grouped = np.flatnonzero(number >= 0)
    order = grouped[
        np.lexsort(
            (
                arrays.missed[grouped],
                arrays.sensor[grouped],
                number[grouped],
                arrays.epoch_ns[grouped],
            )
        )
    ]
    key = np.column_stack([arrays.epoch_ns[order], number[order], arrays.sensor[order]])
    repeated = np.zeros(len(order), bool)
    repeated[1:] = (key[1:] == key[:-1]).all(axis=1)
    kept[order[repeated]] = -1
    order, key = order[~repeated], key[~repeated]
    _, inverse, count = np.unique(key[:, :2], axis=0, return_inverse=True, return_counts=True)
    kept[order[count[inverse.ravel()] < 2]] = -1
    return kept

"""Associate objects: which tracklets of different sensors are one object, window by window.

`associate_objects` calls the method that the settings name. All methods take the same arguments,
samples, focal lengths and settings, and return groups.
"""

import logging
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.schemas.bridge import concat
from epipole.schemas.options import ASSOCIATION, load_method
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.settings import AssociationSettings
from epipole.schemas.tables import REJECTS
from epipole.tasks.algorithms.association.epipolar_lines import associate_by_lines
from epipole.tasks.algorithms.association.likelihood import Shell, associate_tracklets
from epipole.tasks.algorithms.association.samples import FREE, Groups, Samples
from epipole.tasks.algorithms.association.window_groups import WindowGroups
from epipole.tasks.algorithms.orbits.object_motion import ObjectRegistry
from epipole.tasks.algorithms.sensor_faults.suspects import agreement
from epipole.tasks.common.grouping import group_offsets
from epipole.tasks.common.sightings import only_id
from epipole.tasks.solve.association_input import BlockViews, SampledViews, even_instants

LOGGER = logging.getLogger(__name__)


LONGER_WINDOWS_S = (120.0, 600.0)  # of windows for undecided tracklets; each divides a span
# Part of a window for which a tracklet is seen briefly: alone, it shows too little. Found epochs
# rise from 95.3 to 98.5 and from 96.4 to 97.0 % in two scenes; seven others have the same rows.
BRIEFLY = 0.25


class Associated(NamedTuple):
    """The object of each item of a block, -1 for none; and rows of `rejects`.

    `ambiguous` and `undecided` are the items whose tracklet is so, see `Groups`; `agreeing` those
    whose sensor agreed with the others at that time.
    """

    object_number: Indices
    ambiguous: Flags
    undecided: Flags
    agreeing: Flags
    rejects: pa.Table


def associate_objects(
    block: BlockViews, settings: AssociationSettings, max_views: int
) -> Associated:
    """Return the objects of each window: tracklets of two or more sensors that are one object.

    Object numbers count from 0 in the order of first appearance. An object keeps its number from
    window to window as long as one of its tracks continues. A sensor that disagrees with all
    others is left out of a window; if it disagrees in most windows, of the whole block.

    Parameters
    ----------
    max_views
        Limit of the views that are sampled at the same time: they must fit in memory.
    """
    items = block.items
    window_groups = WindowGroups(items)
    windows = _windows(items.window)
    left_out = _associate_windows(block, windows, window_groups, settings, max_views)
    agreeing = np.ones(len(items.window), bool)
    agreeing[np.concatenate([np.zeros(0, np.int64), *left_out])] = False
    rejects = [_reject_table(block, Reason.SENSOR_DISAGREES, rows) for rows in left_out]
    if settings.method == "likelihood":
        _associate_longer(block, windows, window_groups, agreeing, settings)
        window_groups.continue_groups(agreeing, BRIEFLY * settings.window_s)
    numbered = _number_objects(block, window_groups.group, windows)
    number = main_objects(block.track[items.tracklet], numbered, items.n_views)
    ambiguous = window_groups.ambiguous | (number != numbered)
    undecided = window_groups.undecided & ~_have_a_group(items.tracklet, window_groups.group)
    rejects += [
        _reject_tracklets(block, Reason.AMBIGUOUS, np.flatnonzero(ambiguous)),
        _reject_tracklets(block, Reason.UNDECIDED, np.flatnonzero(undecided)),
    ]
    _warn_about(block.sensor_id[np.unique(items.sensor[~agreeing])])
    return Associated(number, ambiguous, undecided, agreeing, concat(REJECTS, rejects))


def _have_a_group(tracklet: Indices, group: Indices) -> Flags:
    """Return whether the tracklet of each item is in a group at any time."""
    return np.asarray(np.bincount(tracklet, group != FREE)[tracklet] > 0)


def _windows(window: Indices) -> list[Indices]:
    """Return the items of each window."""
    cuts = np.searchsorted(window, np.arange(1, window.max(initial=-1) + 1))
    return np.split(np.arange(len(window)), cuts) if len(window) else []


def _sampled_windows(
    block: BlockViews, wanted: Sequence[int], max_views: int
) -> Iterator[tuple[SampledViews, int]]:
    """Yield each wanted window, with the views of as many windows as fit in memory."""
    n_instants = np.array([len(instants) for instants in block.instants])
    n_items = np.bincount(block.items.window, minlength=len(n_instants))
    n_views = (n_instants * n_items)[list(wanted)]
    first = 0
    while first < len(wanted):
        together = np.cumsum(n_views[first:])
        last = first + max(int(np.searchsorted(together, max_views, side="right")), 1)
        chosen = wanted[first:last]
        sampled = SampledViews(block, np.concatenate([block.instants[w] for w in chosen]))
        yield from ((sampled, window) for window in chosen)
        first = last


def _associate_windows(
    block: BlockViews,
    windows: list[Indices],
    window_groups: WindowGroups,
    settings: AssociationSettings,
    max_views: int,
) -> list[Indices]:
    """Enter the groups of all windows; return the items of each window that are left out.

    In a short window, wide errors may hide that a sensor disagrees. So a sensor that disagrees in
    most of the windows in which it is judged is left out of the others too.
    """
    sensor, n_sensors = block.items.sensor, len(block.sensor_id)
    disagrees = np.zeros((len(windows), n_sensors), bool)
    judged = np.zeros_like(disagrees)
    for sampled, window in _sampled_windows(block, range(len(windows)), max_views):
        instants, rows = block.instants[window], windows[window]
        samples, tracklet = sampled.samples(instants, np.zeros(0, np.int64))
        groups = _find_groups(block, instants, samples, settings)
        agreed = agreement(samples, groups)
        judged[window] = agreed.judged
        disagrees[window, agreed.disagreeing()] = True
        if not disagrees[window].any():
            window_groups.enter(rows, tracklet, groups)
    mostly = 2 * disagrees.sum(axis=0) > judged.sum(axis=0)
    left_out = [rows[(disagrees[w] | mostly)[sensor[rows]]] for w, rows in enumerate(windows)]
    again = [w for w, rows in enumerate(left_out) if len(rows)]
    for sampled, window in _sampled_windows(block, again, max_views):
        rows = windows[window]
        window_groups.clear(rows)
        rows = np.setdiff1d(rows, left_out[window])
        if len(rows):
            without = np.flatnonzero(disagrees[window] | mostly)
            instants = block.instants[window]
            samples, tracklet = sampled.samples(instants, without)
            groups = _find_groups(block, instants, samples, settings)
            window_groups.enter(rows, tracklet, groups)
    return [rows for rows in left_out if len(rows)]


def _warn_about(sensors: npt.NDArray[np.str_]) -> None:
    if len(sensors):
        LOGGER.warning(
            "%s: lines of sight agree with no other sensor's (wrong clock, position or "
            "attitude?); left out at these times", ", ".join(sorted(sensors.tolist())),
        )  # fmt: skip


def _associate_longer(
    block: BlockViews,
    windows: list[Indices],
    window_groups: WindowGroups,
    agreeing: Flags,
    settings: AssociationSettings,
) -> None:
    """Associate tracklets again over longer windows: undecided ones, and those of groups that
    another window contradicts."""
    window_before_s = settings.window_s
    for window_s in LONGER_WINDOWS_S:
        if not window_before_s < window_s <= settings.max_window_s:
            continue
        window_groups.doubt(_changing(block, window_groups.group, windows))
        window_groups.doubt(window_groups.contradicted(agreeing, BRIEFLY * settings.window_s))
        longer = block.items.first_ns // round(window_s * 1e9)
        for number in np.unique(longer[agreeing]).tolist():
            rows = np.flatnonzero((longer == number) & agreeing)
            again = window_groups.to_decide_again(rows, window_before_s)
            if len(again):
                instants = _long_instants(block, number, window_s)
                samples, tracklet = _long_samples(block, rows, instants)
                groups = _find_groups(block, instants, samples, settings)
                window_groups.reconsider(rows, again, tracklet, groups)
        window_before_s = window_s
    window_groups.withdraw(window_groups.contradicted(agreeing, BRIEFLY * settings.window_s))


def _changing(block: BlockViews, group: Indices, windows: list[Indices]) -> Indices:
    """Return the items that are of another object than their tracklet mostly is.

    In a window with one detection per sensor, the tracklets of two co-located objects may be
    confused.
    """
    items = block.items
    number = _number_objects(block, group, windows)
    return np.flatnonzero((number >= 0) & ~_in_main(items.tracklet, number, items.n_views))


def _long_instants(block: BlockViews, number: int, window_s: float) -> Indices:
    """Return the instants of a longer window."""
    width_ns = round(window_s * 1e9)
    return even_instants(block.epochs[block.epochs // width_ns == number], block.half_width_s)


def _long_samples(block: BlockViews, rows: Indices, instants: Indices) -> tuple[Samples, Indices]:
    """Return the samples of the items of a longer window, and their tracklets.

    Sensors that were left out in a part of the window take part with their other views.
    """
    sampled = SampledViews(block, instants, agreeing_items=rows)
    return sampled.samples(instants, np.zeros(0, np.int64))


def _number_objects(block: BlockViews, group: Indices, windows: list[Indices]) -> Indices:
    """Return each item's object number: groups that share a track are one object."""
    items, track = block.items, block.track
    registry = ObjectRegistry(np.bincount(track[items.tracklet], items.n_views).astype(float))
    number = np.full(len(group), -1)
    for rows in windows:
        grouped = rows[group[rows] >= 0]
        order = grouped[np.argsort(group[grouped], kind="stable")]
        cuts = np.flatnonzero(np.diff(group[order])) + 1
        members = np.split(order, cuts) if len(order) else []
        tracks = [np.unique(track[items.tracklet[of_group]]) for of_group in members]
        for of_group, object_ in zip(members, registry.name_groups(tracks), strict=True):
            number[of_group] = object_
    return number


def main_objects(track: Indices, number: Indices, n_views: Indices) -> Indices:
    """Return the items' object numbers; an object that no track has as its main one gives -1.

    The main object of a track has the most of its views. Other objects of it are pieces of that
    one, or mix tracks of several objects for a moment.
    """
    main = np.unique(number[_in_main(track, number, n_views)])
    return np.where(np.isin(number, main), number, -1)


def _in_main(track: Indices, number: Indices, n_views: Indices) -> Flags:
    """Return which items are in the main object of their track: (n,) bool."""
    inside = np.flatnonzero(number >= 0)
    pairs, pair = np.unique(
        np.column_stack([track[inside], number[inside]]), axis=0, return_inverse=True
    )
    count = np.bincount(pair.ravel(), n_views[inside], minlength=len(pairs))
    most = np.zeros(track.max(initial=-1) + 1)
    np.maximum.at(most, pairs[:, 0], count)
    out = np.zeros(len(number), bool)
    out[inside] = (count >= most[pairs[:, 0]])[pair.ravel()]
    return out


def _find_groups(
    block: BlockViews, instants: Indices, samples: Samples, settings: AssociationSettings
) -> Groups:
    associate = load_method(ASSOCIATION, settings.method)
    groups: Groups = associate(samples, block.poses.fields_at(instants).focal_px, settings)
    return groups


def _reject_tracklets(block: BlockViews, reason: Reason, left_out: Indices) -> pa.Table:
    """Return a row of `rejects` per tracklet of some items, at its first one.

    Lone detections have no ids: they are counted sensor by sensor.
    """
    items = block.items
    left_out = left_out[np.lexsort((items.first_ns[left_out], items.tracklet[left_out]))]
    tracklet, first = np.unique(items.tracklet[left_out], return_index=True)
    left_out = left_out[first]
    ids = np.array([only_id(block.tracklet_id[[t]]) or "" for t in tracklet.tolist()], object)
    sensor, time = items.sensor[left_out], items.first_ns[left_out]
    order = np.lexsort((time, ids, sensor))
    bounds = group_offsets(sensor[order], ids[order])
    rows = order[bounds[:-1]]
    return reject_rows(
        reason,
        sensor_id=block.sensor_id[sensor[rows]],
        tracklet_id=[name or None for name in ids[rows].tolist()],
        time=time[rows],
        count=np.diff(bounds),
    )


def _reject_table(block: BlockViews, reason: Reason, left_out: Indices) -> pa.Table:
    """Return a row of `rejects` per sensor: how many of its tracklets are left out in a window.

    Parameters
    ----------
    left_out
        Items of the window.
    """
    items = block.items
    tracklet, sensor = items.tracklet[left_out], items.sensor[left_out]
    sensors, count = np.unique(sensor, return_counts=True)
    return reject_rows(
        reason,
        sensor_id=block.sensor_id[sensors],
        tracklet_id=[only_id(block.tracklet_id[tracklet[sensor == s]]) for s in sensors],
        time=[int(items.first_ns[left_out].min())] * len(sensors),
        count=count,
    )


# The methods of association.


def associate_by_likelihood(
    samples: Samples, focal_px: Array, settings: AssociationSettings
) -> Groups:
    """Return the groups of tracklets that are most likely one object each."""
    return associate_tracklets(
        samples,
        gate_sigma=settings.gate_sigma,
        min_altitude_km=settings.min_altitude_km,
        max_range_km=settings.max_range_km,
        min_log_odds=settings.min_log_odds,
        ambiguity_log_odds=settings.ambiguity_log_odds,
        shells=[Shell(s.lowest_km, s.highest_km, s.share) for s in settings.shells],
    )


def associate_by_epipolar_lines(
    samples: Samples, focal_px: Array, settings: AssociationSettings
) -> Groups:
    """Return the groups of tracklets that lie on each other's epipolar lines [published]."""
    return associate_by_lines(samples, focal_px, settings.threshold_px)

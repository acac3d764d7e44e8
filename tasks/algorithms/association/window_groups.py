"""Groups of windows: the group of each tracklet in each window, and how longer windows change it.

Lines of sight to different objects may meet for half a minute, but rarely for ten minutes. So
uncertain groups are decided again over longer windows, as long as their tracklets continue. Certain
groups keep their short windows, because tracklets come and go.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Flags, Indices
from epipole.tasks.algorithms.association.chance import CERTAIN_LOG_ODDS
from epipole.tasks.algorithms.association.samples import FREE, Groups

MIN_LENGTH_RATIO = 2.0  # minimum duration of a tracklet that is decided again, over the last window


class Items(NamedTuple):
    """Each tracklet in each window, in the order of windows and tracklets.

    window, tracklet, sensor : (n,) int
        Windows of time, tracklets and sensors, each numbered from 0.
    first_ns, last_ns, n_views : (n,) int
        First and last epoch [ns] of the tracklet's views in the window, and their number.
    """

    window: Indices
    tracklet: Indices
    sensor: Indices
    first_ns: Indices
    last_ns: Indices
    n_views: Indices


class WindowGroups:
    """The group of each item, numbered through the windows; FREE for no group.

    Items without a group may be ambiguous or undecided, see `Groups`.
    """

    def __init__(self, items: Items) -> None:
        n = len(items.window)
        self.items = items
        self.group = np.full(n, FREE)
        self.ambiguous = np.zeros(n, bool)
        self.undecided = np.zeros(n, bool)
        self._score = np.zeros(0)

    def enter(self, rows: Indices, tracklet: Indices, groups: Groups) -> None:
        """Enter the groups of tracklets (t,), in ascending order, for the items `rows` (r,)."""
        if not len(tracklet):
            return
        at = np.searchsorted(tracklet, self.items.tracklet[rows])
        at = np.minimum(at, len(tracklet) - 1)
        known = tracklet[at] == self.items.tracklet[rows]
        rows, at = rows[known], at[known]
        new = np.where(groups.group == FREE, FREE, groups.group + len(self._score))
        self.group[rows], self.ambiguous[rows] = new[at], groups.ambiguous[at]
        self.undecided[rows] = groups.undecided[at]
        self._score = np.concatenate([self._score, groups.score])

    def clear(self, rows: Indices) -> None:
        """Remove some items from their groups, with what was decided of them."""
        self.group[rows] = FREE
        self.ambiguous[rows] = self.undecided[rows] = False

    def doubt(self, rows: Indices) -> None:
        """Mark the groups of some items as uncertain."""
        groups = self.group[rows]
        self._score[groups[groups != FREE]] = -np.inf

    def contradicted(self, compared: Flags, briefly_s: float) -> Indices:
        """Return the items of groups of two tracklets that both fit no object in another window.

        In that window both are seen for longer than `briefly_s` [s], and are `compared` (n,) bool:
        their sensors are not left out. If two sensors and two objects are nearly in one plane,
        wrong pairs may agree well in one half minute, and not at all in the next.
        """
        items = self.items
        unfit = (self.group == FREE) & ~self.undecided & ~self.ambiguous & compared
        unfit = np.flatnonzero(unfit & (items.last_ns - items.first_ns > briefly_s * 1e9))
        unfit = unfit[np.argsort(items.tracklet[unfit], kind="stable")]
        tracklet, window = items.tracklet[unfit], items.window[unfit]
        pairs = self._pairs()
        begin = np.searchsorted(tracklet, items.tracklet[pairs])
        end = np.searchsorted(tracklet, items.tracklet[pairs], side="right")
        found = np.zeros(len(pairs), bool)
        for k in np.flatnonzero((begin < end).all(axis=1)).tolist():
            one, other = (window[begin[k, c] : end[k, c]] for c in range(2))
            found[k] = np.isin(one, other).any()
        return pairs[found].ravel()

    def _pairs(self) -> Indices:
        """Return the items of each group of two, (n, 2)."""
        rows = np.flatnonzero(self.group != FREE)
        rows = rows[np.argsort(self.group[rows], kind="stable")]
        _, first, size = np.unique(self.group[rows], return_index=True, return_counts=True)
        return np.asarray(rows[first[size == 2][:, None] + np.arange(2)])

    def withdraw(self, rows: Indices) -> None:
        """Remove some items from their groups, and mark them as undecided."""
        self.group[rows] = FREE
        self.undecided[rows] = True

    def continue_groups(self, allowed: Flags, briefly_s: float) -> None:
        """Let the tracklets of a group stay together in neighbouring windows.

        They may be seen there for a few seconds only, too briefly to be grouped again. If none of
        them has a group in the other window, the group continues there

        - if it is certain, and all of them are undecided there;
        - or if at most one of them is seen there for longer than `briefly_s` [s].

        If some are in one group there, the others that are seen briefly join it, unless that group
        has a tracklet of their sensor. Only `allowed` items, (n,) bool, get a group.
        """
        items = self.items
        step = items.tracklet.max(initial=0) + 1
        key = items.window * step + items.tracklet
        brief = items.last_ns - items.first_ns <= briefly_s * 1e9
        sources = np.flatnonzero(self.group != FREE)
        for to_next in (step, -step):
            row = np.minimum(np.searchsorted(key, key[sources] + to_next), len(key) - 1)
            there = key[row] == key[sources] + to_next
            source, row = self.group[sources[there]], row[there]
            group_and_window = source * (items.window.max(initial=0) + 1) + items.window[row]
            order = np.argsort(group_and_window, kind="stable")
            _, starts = np.unique(group_and_window[order], return_index=True)
            for members in np.split(order, starts[1:]) if len(row) else []:
                if ((self.group[row[members]] == FREE) & allowed[row[members]]).any():
                    self._continue(int(source[members[0]]), row[members], allowed, brief)

    def _continue(self, group: int, members: Indices, allowed: Flags, brief: Flags) -> None:
        """Continue a group in another window, where its tracklets are the items `members`."""
        joined = np.unique(self.group[members][self.group[members] != FREE])
        free = members[(self.group[members] == FREE) & allowed[members]]
        if not len(joined):
            sure = self._score[group] >= CERTAIN_LOG_ODDS and self.undecided[free].all()
            of_one_sensor = len(np.unique(self.items.sensor[free])) < 2
            if of_one_sensor or len(free) < len(members) or not (sure or (~brief[free]).sum() <= 1):
                return
            joined = np.array([len(self._score)])
            self._score = np.append(self._score, self._score[group])
        elif len(joined) == 1:
            first, last = np.searchsorted(
                self.items.window, self.items.window[members[0]] + np.arange(2)
            )
            there = self.items.sensor[first:last][self.group[first:last] == joined[0]]
            free = free[brief[free] & ~np.isin(self.items.sensor[free], there)]
        else:
            return
        self.group[free] = joined[0]
        self.undecided[free] = self.ambiguous[free] = False

    def to_decide_again(self, rows: Indices, window_s: float) -> Indices:
        """Return the items of a longer window to decide again; empty if of fewer than two sensors.

        Their tracklets last long enough in it: `MIN_LENGTH_RATIO` times the last window, `window_s`
        [s]. A group is decided again as a whole or not at all: not if it is certain, or if one of
        its tracklets is too short.
        """
        items = self.items
        _, which = np.unique(items.tracklet[rows], return_inverse=True)
        first = np.full(which.max(initial=-1) + 1, np.iinfo(np.int64).max)
        last = np.zeros_like(first)
        np.minimum.at(first, which, items.first_ns[rows])
        np.maximum.at(last, which, items.last_ns[rows])
        continues = (last - first >= MIN_LENGTH_RATIO * window_s * 1e9)[which]
        group = self.group[rows]
        unfit = np.zeros(len(self._score) + 1, bool)
        unfit[:-1] = self._score >= CERTAIN_LOG_ODDS
        unfit[group[~continues & (group != FREE)]] = True
        chosen = rows[continues & ~unfit[group]]  # FREE is -1: the last entry, never unfit
        of_one_sensor = len(np.unique(items.sensor[chosen])) < 2
        return chosen[:0] if of_one_sensor else chosen

    def reconsider(self, rows: Indices, again: Indices, tracklet: Indices, groups: Groups) -> None:
        """Enter the groups of a longer window for those of its items that were decided `again`.

        `rows` are all items of the longer window. In a short window, a new group may share a
        tracklet with a certain group. Then its other tracklets join the certain group there, unless
        their sensor has a tracklet in it already.
        """
        items = self.items
        certain = np.setdiff1d(rows, again)
        certain = certain[self.group[certain] != FREE]
        self.enter(again, tracklet, groups)
        group_of = dict(zip(tracklet.tolist(), groups.group.tolist(), strict=True))
        base = len(self._score) - len(groups.score)
        joined: dict[tuple[int, int], int] = {}
        taken: set[tuple[int, int, int]] = set()
        for row in certain.tolist():
            window, group = int(items.window[row]), int(self.group[row])
            taken.add((window, group, int(items.sensor[row])))
            new_group = group_of.get(int(items.tracklet[row]), FREE)
            if new_group != FREE:
                joined.setdefault((window, base + new_group), group)
        if not joined:
            return
        new = self.group[again].copy()
        for k, row in enumerate(again.tolist()):
            window = int(items.window[row])
            group = joined.get((window, int(new[k])), FREE)
            if group != FREE:
                occupied = (window, group, int(items.sensor[row])) in taken
                new[k] = FREE if occupied else group
        self.group[again] = new

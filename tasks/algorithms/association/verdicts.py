"""Verdicts: which group each view is of, span by span, and what longer evidence changes of it.

Two sensors see two things on one line by chance for half a minute, and rarely for ten. So what a
span leaves unsure is judged again over longer and longer windows in which its tracklets go on;
what is sure keeps its short spans, for tracklets come and go.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.evidence.detection import CERTAIN_LOG_ODDS
from epipole.tasks.algorithms.association.sampling.samples import FREE, Groups

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

LONGER = 2.0  # times the time over which a tracklet was judged, to judge it again


class NightViews(NamedTuple):
    """Views of a night, a row each: epoch [ns], number of the span, tracklet and sensor."""

    epoch_ns: Indices
    span: Indices
    tracklet: Indices
    sensor: Indices


class Verdicts:
    """The group of each row of `NightViews`, numbered through the night; FREE where it is of none."""

    def __init__(self, seen: NightViews) -> None:
        n = len(seen.epoch_ns)
        self.seen = seen
        self.group = np.full(n, FREE)
        self.ambiguous = np.zeros(n, bool)
        self._score = np.zeros(0)

    def enter(self, rows: Indices, tracklet: Indices, groups: Groups) -> None:
        """Enter what the groups of some tracklets say about all their rows among these."""
        at = np.searchsorted(tracklet, self.seen.tracklet[rows])
        at = np.minimum(at, len(tracklet) - 1)
        known = tracklet[at] == self.seen.tracklet[rows]
        rows, at = rows[known], at[known]
        new = np.where(groups.group == FREE, FREE, groups.group + len(self._score))
        self.group[rows], self.ambiguous[rows] = new[at], groups.ambiguous[at]
        self._score = np.concatenate([self._score, groups.score])

    def open_rows(self, rows: Indices, judged_s: float) -> Indices:
        """Return the rows of a window that are to be judged again, none where that is no use.

        They are not of a sure group, and what they are of goes on for longer than `judged_s`,
        over which that was judged: all of a group does.
        """
        seen = self.seen
        _, item = np.unique(seen.tracklet[rows], return_inverse=True)
        first = np.full(item.max(initial=-1) + 1, np.iinfo(np.int64).max)
        last = np.zeros_like(first)
        np.minimum.at(first, item, seen.epoch_ns[rows])
        np.maximum.at(last, item, seen.epoch_ns[rows])
        goes_on = (last - first >= LONGER * judged_s * 1e9)[item]
        group = self.group[rows]
        unfit = np.zeros(len(self._score) + 1, bool)
        unfit[:-1] = self._score >= CERTAIN_LOG_ODDS
        unfit[group[~goes_on & (group != FREE)]] = True
        chosen = rows[goes_on & ~unfit[group]]  # FREE, -1, is the last, and never unfit
        alone = len(np.unique(seen.sensor[chosen])) < 2
        return chosen[:0] if alone else chosen

    def reconsider(
        self, rows: Indices, open_rows: Indices, tracklet: Indices, groups: Groups
    ) -> None:
        """Enter what longer evidence says about the open rows of a window.

        What belongs to a group that is sure in a span joins that, where the sensor has no other
        tracklet in it.
        """
        sure = np.setdiff1d(rows, open_rows)
        sure = sure[self.group[sure] != FREE]
        self.enter(open_rows, tracklet, groups)
        theirs = dict(zip(tracklet.tolist(), groups.group.tolist(), strict=True))
        base = len(self._score) - len(groups.score)
        joined: dict[tuple[int, int], int] = {}
        taken: set[tuple[int, int, int]] = set()
        for row in self._one_a_tracklet(sure):
            span, group = int(self.seen.span[row]), int(self.group[row])
            taken.add((span, group, int(self.seen.sensor[row])))
            longer = theirs.get(int(self.seen.tracklet[row]), FREE)
            if longer != FREE:
                joined.setdefault((span, base + longer), group)
        if not joined:
            return
        first = self._one_a_tracklet(open_rows)
        now = self.group[first].copy()
        for k, row in enumerate(first.tolist()):
            span = int(self.seen.span[row])
            group = joined.get((span, int(now[k])), FREE)
            if group != FREE:
                clash = (span, group, int(self.seen.sensor[row])) in taken
                now[k] = FREE if clash else group
        self.group[open_rows] = now[self._inverse(open_rows)]

    def _key(self, rows: Indices) -> Indices:
        return (
            self.seen.span[rows] * (self.seen.tracklet.max(initial=0) + 1)
            + (self.seen.tracklet[rows])
        )

    def _one_a_tracklet(self, rows: Indices) -> Indices:
        """Return one row of each tracklet and span: its others have the same group."""
        return rows[np.unique(self._key(rows), return_index=True)[1]]

    def _inverse(self, rows: Indices) -> Indices:
        return np.unique(self._key(rows), return_inverse=True)[1]

"""Verdicts: the group of each view, span by span, and how longer evidence changes it.

Two lines of sight to different things may meet by chance for half a minute, but rarely for ten.
So the groups of a span that are not sure are judged again over longer and longer windows, as
long as their tracklets continue. Sure groups keep their short spans, because tracklets come and
go.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.association.evidence.detection import CERTAIN_LOG_ODDS
from epipole.tasks.algorithms.association.sampling.samples import FREE, Groups

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

LONGER = 2.0  # a tracklet is judged again once it is longer than before by this factor


class ViewKeys(NamedTuple):
    """The views of a span, one row each: epoch [ns], number of the window, tracklet, sensor."""

    epoch_ns: Indices
    span: Indices
    tracklet: Indices
    sensor: Indices


class Verdicts:
    """The group of each row of `ViewKeys`, numbered through the span; FREE for no group."""

    def __init__(self, views: ViewKeys) -> None:
        n = len(views.epoch_ns)
        self.views = views
        self.group = np.full(n, FREE)
        self.ambiguous = np.zeros(n, bool)
        self._score = np.zeros(0)

    def enter(self, rows: Indices, tracklet: Indices, groups: Groups) -> None:
        """Enter the groups of some tracklets for those of the rows that are theirs."""
        at = np.searchsorted(tracklet, self.views.tracklet[rows])
        at = np.minimum(at, len(tracklet) - 1)
        known = tracklet[at] == self.views.tracklet[rows]
        rows, at = rows[known], at[known]
        new = np.where(groups.group == FREE, FREE, groups.group + len(self._score))
        self.group[rows], self.ambiguous[rows] = new[at], groups.ambiguous[at]
        self._score = np.concatenate([self._score, groups.score])

    def open_rows(self, rows: Indices, judged_s: float) -> Indices:
        """Return the rows of a window that are to be judged again; empty where that is useless.

        They belong to no sure group, and their tracklets last at least twice the time
        `judged_s` [s] over which they were judged. So do all tracklets of their group.
        """
        views = self.views
        _, item = np.unique(views.tracklet[rows], return_inverse=True)
        first = np.full(item.max(initial=-1) + 1, np.iinfo(np.int64).max)
        last = np.zeros_like(first)
        np.minimum.at(first, item, views.epoch_ns[rows])
        np.maximum.at(last, item, views.epoch_ns[rows])
        continues = (last - first >= LONGER * judged_s * 1e9)[item]
        group = self.group[rows]
        unfit = np.zeros(len(self._score) + 1, bool)
        unfit[:-1] = self._score >= CERTAIN_LOG_ODDS
        unfit[group[~continues & (group != FREE)]] = True
        chosen = rows[continues & ~unfit[group]]  # FREE is -1: the last entry, never unfit
        alone = len(np.unique(views.sensor[chosen])) < 2
        return chosen[:0] if alone else chosen

    def reconsider(
        self, rows: Indices, open_rows: Indices, tracklet: Indices, groups: Groups
    ) -> None:
        """Enter the groups that longer evidence gives for the open rows of a window.

        Where a new group shares a tracklet with a sure group of a span, its other tracklets join
        the sure group in that span. One whose sensor has a tracklet there already is free.
        """
        sure = np.setdiff1d(rows, open_rows)
        sure = sure[self.group[sure] != FREE]
        self.enter(open_rows, tracklet, groups)
        theirs = dict(zip(tracklet.tolist(), groups.group.tolist(), strict=True))
        base = len(self._score) - len(groups.score)
        joined: dict[tuple[int, int], int] = {}
        taken: set[tuple[int, int, int]] = set()
        for row in self._one_per_tracklet(sure):
            span, group = int(self.views.span[row]), int(self.group[row])
            taken.add((span, group, int(self.views.sensor[row])))
            longer = theirs.get(int(self.views.tracklet[row]), FREE)
            if longer != FREE:
                joined.setdefault((span, base + longer), group)
        if not joined:
            return
        first = self._one_per_tracklet(open_rows)
        now = self.group[first].copy()
        for k, row in enumerate(first.tolist()):
            span = int(self.views.span[row])
            group = joined.get((span, int(now[k])), FREE)
            if group != FREE:
                clash = (span, group, int(self.views.sensor[row])) in taken
                now[k] = FREE if clash else group
        self.group[open_rows] = now[self._inverse(open_rows)]

    def _key(self, rows: Indices) -> Indices:
        return (
            self.views.span[rows] * (self.views.tracklet.max(initial=0) + 1)
            + (self.views.tracklet[rows])
        )

    def _one_per_tracklet(self, rows: Indices) -> Indices:
        """Return one row for each tracklet and span; its other rows have the same group."""
        return rows[np.unique(self._key(rows), return_index=True)[1]]

    def _inverse(self, rows: Indices) -> Indices:
        return np.unique(self._key(rows), return_inverse=True)[1]

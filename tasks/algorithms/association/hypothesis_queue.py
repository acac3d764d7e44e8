"""A queue of hypotheses, the likeliest first, that finds those that contradict a given one."""

import heapq
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

from epipole.schemas.arrays import Array, Flags, Integers


@dataclass(frozen=True, eq=False, slots=True)
class Hypothesis:
    """Tracklets (`members`) that may be one object, grown from the two of `seed`.

    `score` is the log-odds against unrelated tracklets. `x_km` (3,) is the position [km] at the
    first solved instant, GCRF. `missed` (n,) are the sensors that have it in their field but no
    tracklet of it.
    """

    score: float
    seed: tuple[int, int]
    members: tuple[int, ...]
    x_km: Array
    missed: Integers


class HypothesisQueue:
    """Hypotheses, the likeliest first; ties by the lowest tracklets."""

    def __init__(self, hypotheses: Iterable[Hypothesis]) -> None:
        self._heap: list[tuple[float, tuple[int, ...], int, Hypothesis]] = []
        self._by_tracklet: dict[int, list[Hypothesis]] = defaultdict(list)
        self._pushed = 0
        for h in distinct(hypotheses):
            self.push(h)

    def push(self, h: Hypothesis) -> None:
        """Add a hypothesis."""
        heapq.heappush(self._heap, (-h.score, h.members, self._pushed, h))
        self._pushed += 1
        for i in h.members:
            self._by_tracklet[i].append(h)

    def pop(self) -> Hypothesis | None:
        """Remove and return the likeliest hypothesis, None if empty. It stays a rival of others."""
        return heapq.heappop(self._heap)[3] if self._heap else None

    def sharing(self, h: Hypothesis) -> list[Hypothesis]:
        """Return the other hypotheses that share a tracklet with h, also those popped before."""
        found = dict.fromkeys(other for i in h.members for other in self._by_tracklet[i])
        return [other for other in found if other is not h]

    def rivals(self, best: Hypothesis, closer_than: float, grouped: Flags) -> list[Hypothesis]:
        """Return hypotheses about as likely as `best` that contradict it.

        They share a tracklet with it, neither contains the other, and none of their tracklets
        belongs to a group already. A hypothesis that was found ambiguous is still a rival.
        """
        return [
            h
            for h in self.sharing(best)
            if h.score > best.score - closer_than
            and not (set(h.members) <= set(best.members) or set(best.members) <= set(h.members))
            and not grouped[list(h.members)].any()
        ]


def distinct(hypotheses: Iterable[Hypothesis]) -> list[Hypothesis]:
    """Return the likeliest hypothesis for each set of members."""
    best: dict[tuple[int, ...], Hypothesis] = {}
    for h in hypotheses:
        if h.members not in best or h.score > best[h.members].score:
            best[h.members] = h
    return list(best.values())

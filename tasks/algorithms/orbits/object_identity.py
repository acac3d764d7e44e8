"""Object identity: an object keeps its number from span to span while a tracklet continues."""

from collections import defaultdict
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Indices = npt.NDArray[np.int64]


class ObjectRegistry:
    """Numbers for groups of tracklets, span after span.

    A group gets the object that most of its tracklets belonged to last. Of two groups that
    claim one object, the one with more of its tracklets gets it. Ties are decided by the lower
    number, so the result depends on the order of the spans only.

    Parameters
    ----------
    weight : (t,) float
        What each tracklet counts, one if missing. A long tracklet is rarely of two objects, a
        short one often.
    """

    def __init__(self, weight: npt.NDArray[np.float64] | None = None) -> None:
        self._weight = weight
        self._object_of: dict[int, int] = {}
        self._count = 0

    def name_groups(self, groups: Sequence[Indices]) -> list[int]:
        """Return the object number of each group of tracklets of one span."""
        claims = []
        for g, members in enumerate(groups):
            held: dict[int, float] = defaultdict(float)
            for t in members.tolist():
                if t in self._object_of:
                    held[self._object_of[t]] += 1.0 if self._weight is None else self._weight[t]
            claims += [(-weight, number, g) for number, weight in held.items()]
        named: dict[int, int] = {}
        for _, number, g in sorted(claims):
            if g not in named and number not in named.values():
                named[g] = number
        for g, members in enumerate(groups):
            if g not in named:
                named[g] = self._count
                self._count += 1
            for t in members.tolist():
                self._object_of[t] = named[g]
        return [named[g] for g in range(len(groups))]

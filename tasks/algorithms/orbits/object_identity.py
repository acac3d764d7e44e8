"""Object identity: an object keeps its number from span to span while a tracklet continues."""

from collections import Counter
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

Indices = npt.NDArray[np.int64]


class ObjectRegistry:
    """Numbers for groups of tracklets, span after span.

    A group gets the object that most of its tracklets belonged to last. Of two groups that
    claim one object, the one with more of its tracklets gets it. Ties are decided by the lower
    number, so the result depends on the order of the spans only.
    """

    def __init__(self) -> None:
        self._object_of: dict[int, int] = {}
        self._count = 0

    def name_groups(self, groups: Sequence[Indices]) -> list[int]:
        """Return the object number of each group of tracklets of one span."""
        claims = []
        for g, members in enumerate(groups):
            held = Counter(self._object_of[t] for t in members.tolist() if t in self._object_of)
            claims += [(-count, number, g) for number, count in held.items()]
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

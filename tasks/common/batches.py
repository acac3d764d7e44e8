"""Batches: the work of a stage, divided into tasks of about equal work.

A task costs about 10 ms of CPU, with Dask 150 ms, and some kilobytes of the scheduler's memory,
however little it does. So it gets as many sensors and spans as make it worth this. The rows of a
night do not depend on the division: each part depends on its sensor and span only.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from typing import Generic, TypeVar

import numpy as np

T = TypeVar("T")

# Work of a task [frames]: half an hour of one sensor at 2 Hz, about 2 s of CPU. The cost of a task
# is then 0.5 % of its work.
FRAMES_OF_TASK = 3600
# A stage with less work than `MANY_TASKS` such tasks has smaller ones, so that every worker has
# something to do; but none smaller than `SMALL_TASK` [frames], half a second of CPU. With this
# bound 192 sensors of 60 frames took 8 % less CPU in threads, and half as much with Dask, where a
# task costs 0.15 s.
MANY_TASKS = 64
SMALL_TASK = 1200
FEW_TASKS = 8  # a stage with less work still has this many, for the processors of one machine
MAX_TASKS = 800  # of a stage, whatever its work: about twelve times this many in a night
# What a sensor and span costs beside its frames, as a number of frames: files, tables, catalogues.
OF_PIECE = 60


class Batch(Generic[T]):
    """The pieces of work of one task; as text, the first piece and how many more there are.

    Not a tuple: Prefect looks into tuples for results of other tasks, piece by piece.
    """

    __slots__ = ("pieces",)

    def __init__(self, pieces: Sequence[T]) -> None:
        self.pieces = tuple(pieces)

    def __iter__(self) -> Iterator[T]:
        """Return an iterator over the pieces."""
        return iter(self.pieces)

    def __len__(self) -> int:
        """Return the number of pieces."""
        return len(self.pieces)

    def __str__(self) -> str:
        """Return a name for the task run, such as ``cam1 04:00-04:30 and 11 more``."""
        more = len(self.pieces) - 1
        return f"{self.pieces[0]} and {more} more" if more else f"{self.pieces[0]}"


def in_batches(pieces: Sequence[T], n_frames: Sequence[int]) -> list[Batch[T]]:
    """Return the pieces, in their order, in batches of about the same work.

    Parameters
    ----------
    pieces
        The work of a stage, such as sensors and spans.
    n_frames
        The number of frames of each piece.
    """
    if not pieces:
        return []
    before = np.concatenate([[0], np.cumsum(np.asarray(n_frames, np.int64) + OF_PIECE)])
    total = int(before[-1])
    small = min(total // SMALL_TASK, MANY_TASKS)
    count = min(max(math.ceil(total / FRAMES_OF_TASK), small, FEW_TASKS), MAX_TASKS)
    # Each piece goes to the batch in which its middle lies.
    batch = (before[:-1] + before[1:]) * count // (2 * total)
    bounds = np.concatenate([[0], np.flatnonzero(np.diff(batch)) + 1, [len(pieces)]])
    return [Batch(pieces[a:b]) for a, b in itertools.pairwise(bounds)]

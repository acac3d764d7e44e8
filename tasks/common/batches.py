"""Batches: the work of a stage, divided into tasks of about equal work.

A task costs about 10 ms of CPU and some kilobytes of the scheduler's memory, however little it
does. So it gets as many sensors and spans as make it worth this. The rows of a night do not depend
on the division: each part depends on its sensor and span only.
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
# A stage with less work than this many such tasks has smaller ones, so that every worker of one
# machine has something to do.
MIN_TASKS = 64
MAX_TASKS = 800  # of a stage, whatever its work: about twelve times this many in a night


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
    """Return the pieces, in their order, in batches of about the same number of frames.

    Parameters
    ----------
    pieces
        The work of a stage, such as sensors and spans.
    n_frames
        The number of frames of each piece. One without frames counts as one.
    """
    if not pieces:
        return []
    n = np.maximum(np.asarray(n_frames, np.int64), 1)
    before = np.concatenate([[0], np.cumsum(n)])
    total = int(before[-1])
    count = min(max(math.ceil(total / FRAMES_OF_TASK), MIN_TASKS), MAX_TASKS)
    # Each piece goes to the batch in which its middle lies.
    batch = (before[:-1] + before[1:]) * count // (2 * total)
    bounds = np.concatenate([[0], np.flatnonzero(np.diff(batch)) + 1, [len(pieces)]])
    return [Batch(pieces[a:b]) for a, b in itertools.pairwise(bounds)]

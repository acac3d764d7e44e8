"""The budget of searches: what those of one sensor's frames may cost together, and each frame.

Costs are counted work, so what is searched is the same on every machine. A pass over the frames
takes a share of what is left. Within the pass, the share is earned from frame to frame: frames that
no search can identify do not spend what later ones need.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Indices

# What all searches of one frame may cost, as part of the setting `identification.time_limit_s`; the
# rest is left to all else. A sensor's searches may cost a tenth of that per frame: 42 ms with the
# default of 0.5 s. Frames that are followed cost a hundredth of it; crowds come near it.
AT_ONCE, PER_FRAME = 0.84, 0.084
# What is left of a frame's budget, or of a pass's, is too little for a search [s].
TOO_LITTLE_S = 0.002
HEAD_START = 0.25  # part of a pass's share with which it begins; all of it where one frame will do


class SearchBudget:
    """What searches have cost so far, and may cost; changed by each search.

    at_once_s : float, what one frame may cost
    total_s, spent_s : float, of all frames
    frame_s : (F,) float, spent on each
    """

    def __init__(self, n_frames: int, time_limit_s: float, share: float = 1.0) -> None:
        self.at_once_s = AT_ONCE * time_limit_s
        self.total_s = share * time_limit_s * max(AT_ONCE, PER_FRAME * n_frames)
        self.spent_s = 0.0
        self.frame_s = np.zeros(n_frames)

    def allow(self, rows: Indices, share: float, one_will_do: bool = False) -> "Allowance":
        """Return what a pass over these frames may cost: a share of what is left."""
        size_s = share * (self.total_s - self.spent_s)
        return Allowance(self, rows, self.spent_s, size_s, 1.0 if one_will_do else HEAD_START)


class Allowance(NamedTuple):
    """What a pass over some frames may cost.

    budget : SearchBudget, that of the sensor
    rows : (n,) int64, the frames of the pass, in its order of time
    start_s, size_s : float, what was spent before, and what the pass may spend
    head_start : part of that with which it begins
    """

    budget: SearchBudget
    rows: Indices
    start_s: float
    size_s: float
    head_start: float

    def left_s(self, k: int, share_done: float) -> float:
        """Return what a search of frame k of the pass may cost, after this share of its frames."""
        earned = self.size_s * max(share_done, self.head_start)
        of_pass = self.start_s + earned - self.budget.spent_s
        return float(min(of_pass, self.budget.at_once_s - self.budget.frame_s[self.rows[k]]))

    def spend(self, k: int, seconds: float) -> None:
        """Enter what a search of frame k of the pass has cost."""
        self.budget.spent_s += seconds
        self.budget.frame_s[self.rows[k]] += seconds

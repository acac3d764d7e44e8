"""Runs of rows that are equal in some columns."""

from typing import Any

import numpy as np
import numpy.typing as npt


def group_offsets(*keys: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """Return where each run of rows that are equal in all keys begins, and where the last one ends.

    Run k has the rows ``bounds[k]:bounds[k + 1]``. Without rows it is [0]: no run.
    """
    begins = np.ones(len(keys[0]), bool)
    begins[1:] = np.any([key[1:] != key[:-1] for key in keys], axis=0)
    return np.append(np.flatnonzero(begins), len(begins)).astype(np.int64)

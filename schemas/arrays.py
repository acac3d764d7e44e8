"""The kinds of NumPy arrays that signatures name."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
"""Measured and computed numbers; the docstring says their shape and unit."""
Integers = npt.NDArray[np.int64]
"""Counts, numbers of frames and groups."""
Indices = npt.NDArray[np.int64]
"""Rows of another array."""
Nanoseconds = npt.NDArray[np.int64]
"""Times since 1970-01-01, UTC, or durations."""
Flags = npt.NDArray[np.bool_]
"""Yes or no for each row."""

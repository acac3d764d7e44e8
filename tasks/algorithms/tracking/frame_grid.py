"""Grids over the detections of the latest frames, to look up what lies near a direction.

A frame is projected on the plane across its mean direction. That makes no distance longer, so that
all detections within a reach are in the cells that the reach touches. A grid is a tuple of arrays,
as compiled code takes them; slot k of each belongs to the frames k, k + size, ...
"""

import numpy as np

from epipole.tasks.algorithms.kernels import kernel

FINEST = 128  # most cells along a side


@kernel
def make_grids(size, most):
    """Return arrays for `size` frames of at most `most` detections."""
    side = max(min(int(np.sqrt(most)), FINEST), 1)
    axes = np.zeros((size, 2, 3))
    shape = np.zeros((size, 4))  # lowest on both axes, cells per unit, cells along a side
    start = np.zeros((size, side * side + 1), np.int64)
    items = np.zeros((size, max(most, 1)), np.int64)
    return axes, shape, start, items


@kernel
def _lay_axes(directions, lo, hi, axes):
    """Set two axes across the mean direction of a frame."""
    mean = np.zeros(3)
    for j in range(lo, hi):
        for a in range(3):
            mean[a] += directions[j, a]
    flat = 0
    for a in range(1, 3):
        if abs(mean[a]) < abs(mean[flat]):
            flat = a
    second, third = (flat + 1) % 3, (flat + 2) % 3
    norm = np.sqrt(mean[second] ** 2 + mean[third] ** 2)
    axes[:] = 0.0
    if norm == 0.0:
        axes[0, second] = 1.0
        axes[1, flat] = 1.0
        return
    axes[0, second], axes[0, third] = mean[third] / norm, -mean[second] / norm
    total = np.sqrt(norm**2 + mean[flat] ** 2)
    axes[1, flat] = norm / total
    axes[1, second] = -mean[second] * mean[flat] / norm / total
    axes[1, third] = -mean[third] * mean[flat] / norm / total


@kernel
def _along(u, axis):
    return u[0] * axis[0] + u[1] * axis[1] + u[2] * axis[2]


@kernel
def fill_grid(grids, slot, directions, lo, hi):
    """Lay the detections lo:hi of a frame into a slot."""
    axes, shape, start, items = grids
    n = hi - lo
    side = max(min(int(np.sqrt(n)), int(np.sqrt(start.shape[1] - 1))), 1)
    start[slot, : side * side + 1] = 0
    shape[slot, 3] = side
    if n == 0:
        return
    _lay_axes(directions, lo, hi, axes[slot])
    place = np.empty((n, 2))
    for k in range(n):
        place[k, 0] = _along(directions[lo + k], axes[slot, 0])
        place[k, 1] = _along(directions[lo + k], axes[slot, 1])
    low_0, low_1 = place[:, 0].min(), place[:, 1].min()
    extent = max(place[:, 0].max() - low_0, place[:, 1].max() - low_1, 1e-12)
    shape[slot, 0], shape[slot, 1], shape[slot, 2] = low_0, low_1, side / extent
    cell = np.empty(n, np.int64)
    for k in range(n):
        x = min(int((place[k, 0] - low_0) * shape[slot, 2]), side - 1)
        y = min(int((place[k, 1] - low_1) * shape[slot, 2]), side - 1)
        cell[k] = y * side + x
        start[slot, cell[k] + 1] += 1
    for c in range(side * side):
        start[slot, c + 1] += start[slot, c]
    at = start[slot, : side * side].copy()
    for k in range(n):
        items[slot, at[cell[k]]] = lo + k
        at[cell[k]] += 1


@kernel
def window(grids, slot, u, reach):
    """Return the cells that a reach about a direction touches: x from, to, y from, to, side.

    The cells x from .. to of a row y hold the items start[y * side + x from] to
    start[y * side + x to + 1]. Empty (x from above x to) where nothing is near.
    """
    axes, shape = grids[0], grids[1]
    side = int(shape[slot, 3])
    scale = shape[slot, 2]
    x = _along(u, axes[slot, 0]) - shape[slot, 0]
    y = _along(u, axes[slot, 1]) - shape[slot, 1]
    x_from, x_to = np.floor((x - reach) * scale), np.floor((x + reach) * scale)
    y_from, y_to = np.floor((y - reach) * scale), np.floor((y + reach) * scale)
    # The last cell holds its upper edge as well.
    if x_to < 0 or y_to < 0 or x_from > side or y_from > side:
        return 1, 0, 1, 0, side
    last = side - 1.0
    return (
        int(min(max(x_from, 0.0), last)), int(min(x_to, last)),
        int(min(max(y_from, 0.0), last)), int(min(y_to, last)), side,
    )  # fmt: skip

"""Stars in a crowd, by their motion.

Where most centroids of a frame are satellites that the sensor follows, or spots that stay on their
pixels, a search among all of them fails, or takes long. But one rotation moves all stars from a
frame to a later one, and it does not fit the others. So the centroids are divided into groups, each
with one rotation. A group of a few stars is searched quickly.

1. Links: each centroid with each one near it in the later frame.
2. The most frequent shift gives a rotation. The links that it fits are the first group: the crowd.
3. Of the others, two links agree if the distance between their centroids is the same in both
   frames. The link with which most others agree gives, with these, the next rotation and group.
4. Step 3 is repeated without the centroids of that group.
"""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.geometry.attitude import optimal_attitude
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids

# Times between the two frames [s]; sensors that follow satellites turn by 0.01 deg/s against the
# stars, those that look away from the Earth by 0.06. A gap may be longer by the factor `LATE`.
GAPS_S, LATE = (10.0, 1.0), 2.0
REACH = 0.2  # of the half diagonal of the image: the farthest that stars move between the frames
MAX_ROLL_RAD = 0.15  # between the frames
# Error of a link, the larger of these [px] and [sigma of a centroid]: satellites of a crowd move by
# half a pixel against each other in 10 s.
TOLERANCE_PX, TOLERANCE_SIGMA = 1.0, 5.0
MIN_GROUP = 4  # centroids; among 60 random points, three links often agree
MAX_SHARE = 0.5  # of a frame's centroids: stars in a larger group are found without it
BRIGHTEST = 150  # centroids of a frame that take part: links grow as their square
MAX_LINKS = 600  # of which each is compared with each
MAX_GROUPS, MAX_SEEDS, ROUNDS = 6, 12, 4  # per pair of frames; links tried; fits of a rotation


def moving_groups(
    centroids: RawCentroids, t_s: Array, rows: Indices
) -> tuple[RawCentroids, Indices]:
    """Return groups of centroids that move together, each as a frame, and the frame of each.

    Parameters
    ----------
    centroids
        Of all F frames of a sensor.
    t_s : (F,) float
        Times of the frames [s], ascending.
    rows : (n,) int64
        Frames that are divided into groups.
    """
    parts, of_frame = [], []
    for row in rows:
        for later in _later_frames(t_s, row):
            for group in _groups_between(centroids, row, later):
                parts.append(centroids.first[row] + group)
                of_frame.append(row)
    frame = np.array(of_frame, np.int64)
    return centroids.parts(parts, frame), frame


def _later_frames(t_s: Array, row: int) -> Iterator[int]:
    """Yield the frames that this one is compared with."""
    for gap_s in GAPS_S:
        later = int(np.searchsorted(t_s, t_s[row] + gap_s))
        if later < len(t_s) and t_s[later] <= t_s[row] + LATE * gap_s:
            yield later


def _groups_between(centroids: RawCentroids, row: int, later: int) -> Iterator[Indices]:
    """Yield the groups of a frame that move to a later one, ascending."""
    one, two = (_brightest(centroids, frame) for frame in (row, later))
    u, v = centroids.u[one], centroids.u[two]
    if min(len(u), len(v)) < MIN_GROUP:
        return
    pixel_rad = float(np.median(centroids.pixel_rad[one]))
    sigma_px = np.nan_to_num(centroids.sigma_px[one])
    tolerance = max(TOLERANCE_PX, TOLERANCE_SIGMA * float(np.median(sigma_px))) * pixel_rad
    reach = REACH * centroids.optics[centroids.optics_of[row]].half_diagonal_rad
    for group in groups_that_move(u, v, reach, tolerance):
        if len(group) <= MAX_SHARE * len(u):
            yield group


def _brightest(centroids: RawCentroids, row: int) -> slice:
    """Return which centroids of a frame take part."""
    first, last = centroids.first[row : row + 2]
    return slice(first, min(last, first + BRIGHTEST))


def groups_that_move(u: Array, v: Array, reach: float, tolerance: float) -> Iterator[Indices]:
    """Yield groups of directions that one rotation each takes from one frame to another.

    Parameters
    ----------
    u, v : (n, 3), (m, 3) float
        Unit vectors in the earlier and the later frame, sensor axes.
    reach, tolerance
        How far a direction may move between them, and the error of a movement [rad].

    Yields
    ------
    (g,) int64
        Rows of u, ascending; the largest group first.
    """
    i, k = np.nonzero(cdist(u, v) < reach)
    if len(i) < MIN_GROUP:
        return
    members = _densest(v[k] - u[i], 2.0 * tolerance)
    members = _fitted_links(u[i], v[k], np.ones(len(i), bool), members, tolerance)
    if len(np.unique(i[members])) >= MIN_GROUP:
        yield np.unique(i[members])
        left = ~(np.isin(i, i[members]) | np.isin(k, k[members]))
        i, k = i[left], k[left]
    if len(i) <= MAX_LINKS:
        yield from _groups_that_agree(u, v, i, k, tolerance)


def _densest(points: Array, radius: float) -> Flags:
    """Return which points (n, 3) are within `radius` of the one with most others near it."""
    tree = KDTree(points)
    middle = np.argmax(tree.query_ball_point(points, radius, return_length=True))
    return np.asarray(np.linalg.norm(points - points[middle], axis=1) < radius)


def _groups_that_agree(
    u: Array, v: Array, i: Indices, k: Indices, tolerance: float
) -> Iterator[Indices]:
    """Yield groups of links (i, k) that agree, as centroids of u."""
    agree = _agreement(u, v, i, k, tolerance)
    free, groups = np.ones(len(i), bool), 0
    for _ in range(MAX_SEEDS):
        votes = np.where(free, agree @ free.astype(np.float32), 0.0)
        seed = int(np.argmax(votes)) if len(votes) else 0
        if groups == MAX_GROUPS or not len(votes) or votes[seed] < MIN_GROUP - 1:
            return
        members = _fitted_links(u[i], v[k], free, (agree[seed] > 0) & free, tolerance)
        group = np.unique(i[members])
        if len(group) < MIN_GROUP:
            free[seed] = False
            continue
        groups += 1
        yield group
        free &= ~(np.isin(i, group) | np.isin(k, k[members]))


def _agreement(
    u: Array, v: Array, i: Indices, k: Indices, tolerance: float
) -> npt.NDArray[np.float32]:
    """Return (links, links): 1 where two links agree, else 0."""
    before, after, moved = cdist(u, u)[np.ix_(i, i)], cdist(v, v)[np.ix_(k, k)], v[k] - u[i]
    agree = (np.abs(after - before) < tolerance) & (before > 2 * tolerance)
    agree &= cdist(moved, moved) < tolerance + MAX_ROLL_RAD * before
    return agree.astype(np.float32)


def _fitted_links(u: Array, v: Array, free: Flags, members: Flags, tolerance: float) -> Flags:
    """Return which free links the rotation of the members fits, refined with these links."""
    for _ in range(ROUNDS):
        weights = np.ones(members.sum())
        R, _ = optimal_attitude(v[members], u[members], weights)
        taken = free & (np.linalg.norm(u @ R.T - v, axis=1) < tolerance)
        if taken.sum() < MIN_GROUP or np.array_equal(taken, members):
            return taken
        members = taken
    return members

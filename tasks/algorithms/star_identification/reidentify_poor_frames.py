"""A second look at frames that show far fewer of their centroids to be stars than the sensor's
other frames do.

Two things make them so. The centroids are worse than those of other frames (the sensor turned or
shook): of many stars, the few that are near their places by chance are matched, and the attitude
has their error, not that of all. Or a few matches near a predicted attitude are no stars of the
field: the spots of bright stars that stay on a detector look like the frame before. So these frames
are matched again with larger errors, and the centroids that are left over are searched for another
attitude. What explains the frame better is taken.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.star_identification.frames.centroids import SensorCentroids, Solutions
from epipole.tasks.algorithms.star_identification.frames.frame import (
    FrameCentroids,
    Search,
    Solution,
    identify_lost,
    some_centroids,
)
from epipole.tasks.algorithms.star_identification.sensor_limits import rematch
from epipole.tasks.algorithms.star_identification.sky.camera_sky import Sky
from epipole.tasks.algorithms.star_identification.sky.pair_table import PairTable
from epipole.tasks.algorithms.star_identification.sky.sky_grid import SkyGrid

Array = npt.NDArray[np.float64]

POOR = 0.6  # of the share of centroids that are stars, in the sensor's typical frame
LEAST_FRAMES = 5  # from which that is known
MORE_STARS = 1.5  # times as many are shown with larger errors, if these are true
LIKELIER = 3.0  # (ln) least gain in evidence to replace an attitude
WORSE = (2.0, 4.0, 8.0, 16.0)  # factors on errors
SETTLING, LEAST_DOF = 3, 5  # iterations of rescaling the errors; least degrees of freedom
PATIENCE = 4  # searches in a row that find nothing better; then ever fewer frames are searched


class SensorSky(NamedTuple):
    """What frames are searched in: the stars, their grid, and a source of their pairs."""

    sky: Sky
    grid: SkyGrid
    pairs: Callable[[], PairTable]


def poor_frames(solutions: Solutions) -> npt.NDArray[np.int64]:
    """Return the frames that show far fewer of their centroids to be stars than is usual."""
    counts = np.diff(solutions.first)
    frame = np.repeat(np.arange(len(counts)), counts)
    share = np.bincount(frame, solutions.star >= 0, minlength=len(counts)) / np.maximum(counts, 1)
    if solutions.solved.sum() < LEAST_FRAMES:
        return np.empty(0, np.int64)
    return np.flatnonzero(solutions.solved & (share < POOR * np.median(share[solutions.solved])))


def reidentify_poor_frames(
    frames: SensorCentroids, solutions: Solutions, where: SensorSky, how: Search
) -> Array:
    """Enter better solutions of poor frames; return (F,) factors on the errors of each frame.

    `solutions` are changed.
    """
    factors, failures, skipped = np.ones(len(solutions.solved)), 0, 0
    for k in poor_frames(solutions).tolist():
        frame, known = frames.frame(k), solutions.frame(k)
        assert known is not None
        better = _with_larger_errors(frame, known, where.sky, how)
        if better is None and skipped > 0:
            skipped -= 1
            continue
        if better is None:
            better = _searched(frame, known, where, how)
            failures = 0 if better else failures + 1
            skipped = 2 ** min(max(failures - PATIENCE, 0), 10) - 1
        if better is not None:
            solution, factors[k] = better
            solutions.enter(k, solution)
    return factors


def _with_larger_errors(
    frame: FrameCentroids, known: Solution, sky: Sky, how: Search
) -> tuple[Solution, float] | None:
    """Return the likeliest solution near the known one with larger errors, and the factor on these;
    None where it shows hardly more stars."""
    tried = [(_near(frame, known, sky, how, factor), factor) for factor in WORSE]
    more = [(found, factor) for found, factor in tried if found and _shows_more(found, known)]
    if not more:
        return None
    best, factor = max(more, key=lambda one: one[0].evidence)
    for _ in range(SETTLING):
        dof = 2 * _n_stars(best) - 3
        if dof < LEAST_DOF:
            break
        own = max(factor * float(np.sqrt(best.chi2[best.star >= 0].sum() / dof)), 1.0)
        settled = _near(frame, best, sky, how, own)
        if settled is None or not _shows_more(settled, known):
            break
        best, factor = settled, own
    return best, factor


def _near(
    frame: FrameCentroids, known: Solution, sky: Sky, how: Search, factor: float
) -> Solution | None:
    """Return the solution near a known one with errors so many times as large."""
    worse = frame._replace(sigma_rad=factor * frame.sigma_rad)
    return rematch([worse], [known], sky, how)[0]


def _searched(
    frame: FrameCentroids, known: Solution, where: SensorSky, how: Search
) -> tuple[Solution, float] | None:
    """Return the solution of a search of the whole sky with the centroids that are left over, None
    where it is hardly likelier.

    With all of them, the search would end with the known solution if that is beyond doubt.
    """
    left_over = some_centroids(frame, np.flatnonzero(known.star < 0))
    quick = how._replace(crowded=False)
    found = identify_lost(left_over, where.sky, where.grid, where.pairs(), quick)[0]
    found = found and _near(frame, found, where.sky, how, 1.0)
    if found is None:
        return None
    same = _near(frame, known, where.sky, how, 1.0)  # judged as if it had been searched, too
    if same is not None and found.evidence < same.evidence + LIKELIER:
        return None
    return found, 1.0


def _shows_more(found: Solution, known: Solution) -> bool:
    return _n_stars(found) >= MORE_STARS * _n_stars(known)


def _n_stars(solution: Solution) -> int:
    return int(np.count_nonzero(solution.star >= 0))

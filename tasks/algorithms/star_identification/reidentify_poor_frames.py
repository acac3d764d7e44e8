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
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.star_identification.centroids import (
    RawCentroids,
    SensorCentroids,
    Solutions,
    unsolved,
)
from epipole.tasks.algorithms.star_identification.frame import (
    FieldOfView,
    FrameCentroids,
    Search,
    Solution,
    identify_lost,
    some_centroids,
)
from epipole.tasks.algorithms.star_identification.sensor_model import frame_scales, rematch
from epipole.tasks.algorithms.star_identification.sequence import (
    Priors,
    identify_again,
    identify_sequence,
)
from epipole.tasks.algorithms.star_identification.star_grid import Sky, SkyGrid
from epipole.tasks.algorithms.star_identification.star_pairs import PairTable

# -- A second look at frames that show far fewer of their centroids to be stars than the sensor's
# other frames do.
#
# Two things make them so. The centroids are worse than those of other frames (the sensor turned
# or shook): of many stars, the few that are near their places by chance are matched, and the
# attitude has their error, not that of all. Or a few matches near a predicted attitude are no
# stars of the field: the spots of bright stars that stay on a detector look like the frame
# before. So these frames are matched again with larger errors, and the centroids that are left
# over are searched for another attitude. What explains the frame better is taken.

Array = npt.NDArray[np.float64]

POOR = 0.6  # of the share of centroids that are stars, in the sensor's typical frame
MIN_FRAMES = 5  # from which that is known
MORE_STARS = 1.5  # times as many are shown with larger errors, if these are true
LIKELIER = 3.0  # (ln) least gain in evidence to replace an attitude
WORSE = (2.0, 4.0, 8.0, 16.0)  # factors on errors
SETTLING, MIN_DOF = 3, 5  # iterations of rescaling the errors; least degrees of freedom
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
    if solutions.solved.sum() < MIN_FRAMES:
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
        if dof < MIN_DOF:
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


# -- Some frames of one sensor, what is known of it, and their identification with that.


class Skies(Protocol):
    """The source of skies; it may cache them, as sensors share them."""

    def limit_for(self, stars_per_sr: float) -> float:
        """Return the magnitude limit with this mean density."""

    def sky(self, limit: float) -> Sky:
        """Return the sky to a magnitude."""

    def grid(self, limit: float, radius_rad: float) -> SkyGrid:
        """Return its grid."""

    def pairs(self, limit: float, optics: FieldOfView) -> PairTable:
        """Return its pattern pairs for a camera."""


class Known(NamedTuple):
    """What has been learned of a sensor."""

    scale: float  # on the errors as stated, or on 1 px
    limit: float  # faintest star searched for
    limit_is_open: bool  # the settings do not state it
    how: Search
    use_flux: bool  # brightness is compared
    adjusted: bool  # errors are not as stated, or not stated


class Sample(NamedTuple):
    """Frames, with their priors; `anchors` are frames whose prior is an earlier solution."""

    t_s: Array
    spots: RawCentroids
    priors: Priors
    anchors: bool = False

    def take(self, rows: npt.NDArray[np.int64]) -> "Sample":
        priors = Priors(self.priors.R_sensor_from_icrs[rows], self.priors.sigma_rad[rows])
        return Sample(self.t_s[rows], self.spots.take(rows), priors, self.anchors)

    def anchored(self, rows: npt.NDArray[np.int64], solutions: list[Solution | None]) -> "Sample":
        """Return the frames with these solutions as priors, where they have none of their own."""
        R, sigma = self.priors.R_sensor_from_icrs.copy(), self.priors.sigma_rad.copy()
        for row, solution in zip(rows, solutions, strict=True):
            if solution is not None and np.isnan(self.priors.sigma_rad[row]):
                R[row] = solution.R_sensor_from_icrs
                # Errors and sky were other ones: it may be off by more than it says.
                sigma[row] = 3.0 * np.sqrt(np.trace(solution.cov_rad2) / 3.0)
        return self._replace(priors=Priors(R, sigma), anchors=True)

    def of_quality(self, quality: Array) -> "Sample":
        """Return the frames with these factors on their errors."""
        spots = self.spots
        stated = np.where(np.isnan(spots.sigma_px), 1.0, spots.sigma_px)
        scaled = spots._replace(sigma_px=stated * np.repeat(quality, spots.counts))
        return self._replace(spots=scaled)


def identify_sample(
    sample: Sample, skies: Skies, known: Known, hopeless: bool = False
) -> tuple[Solutions, list[str | None]]:
    """Return the frames' solutions and status; `hopeless` ones have failed so far."""
    if not len(sample.t_s):
        return unsolved(sample.spots.first), []
    frames = sample.spots.frames(known.scale, known.use_flux)
    return identify_sequence(
        sample.t_s, frames, sample.priors, *sky_of(sample.spots, skies, known), known.how,
        sample.anchors, hopeless,
    )  # fmt: skip


def sky_of(spots: RawCentroids, skies: Skies, known: Known) -> SensorSky:
    """Return what the frames are searched in."""
    radius = _grid_radius(spots.frames(known.scale), known.how)
    pairs = partial(skies.pairs, known.limit, spots.optics[0])
    return SensorSky(skies.sky(known.limit), skies.grid(known.limit, radius), pairs)


def _grid_radius(frames: SensorCentroids, how: Search) -> float:
    """Return the widest look-up [rad], rounded up so that similar sensors share a grid."""
    sigma = frames.sigma_rad
    widest = 2.5 * how.gate_sigma * float(np.median(sigma)) if len(sigma) else 1e-3
    return float(min(2.0 ** (np.ceil(2 * np.log2(widest)) / 2), 0.1))


# -- Frames unlike the sensor's others: another brightness of the same stars, other errors.

# Rounds of learning other errors, the change (ln) that ends them, and the factor on errors from
# which frames are searched again.
QUALITY_ROUNDS, SETTLED, OTHER_QUALITY = 6, 0.02, 1.25
# Frames that failed are tried with the errors of the sensor's worst and best tenth, and with errors
# larger by this factor.
MUCH_WORSE = 8.0
OTHER_TRIALS = 4  # the brightness, and these


def of_other_brightness(
    whole: Sample, solutions: Solutions, skies: Skies, known: Known
) -> Solutions:
    """Return the solutions with those of frames whose zero point is not that of the others: other
    exposure, other gain."""
    how = known.how._replace(
        zero_point_mag=np.nan, threshold=known.how.threshold + np.log(OTHER_TRIALS), crowded=False
    )
    rows = np.flatnonzero(~solutions.solved & (whole.spots.counts >= 4))
    if known.use_flux and not np.isnan(known.how.zero_point_mag) and len(rows):
        found = identify_sample(whole.take(rows), skies, known._replace(how=how), hopeless=True)[0]
        solved = np.flatnonzero(found.solved)
        solutions.enter_all(rows[solved], found, solved)
    return solutions


def by_quality(
    whole: Sample, solutions: Solutions, quality: Array, skies: Skies, known: Known
) -> tuple[Solutions, Array]:
    """Return the solutions with each frame's own errors, and these over those of the sensor.

    Frames that are not identified are searched as better and as worse ones.
    """
    solutions, quality = _settle_quality(whole, solutions, quality, skies, known)
    if not solutions.solved.any():
        return solutions, quality
    how = known.how._replace(threshold=known.how.threshold + np.log(OTHER_TRIALS), crowded=False)
    for other in (*np.quantile(quality[solutions.solved], (0.9, 0.1)), MUCH_WORSE):
        rows = np.flatnonzero(~solutions.solved & (whole.spots.counts >= 4))
        if abs(np.log(other)) < np.log(OTHER_QUALITY) or not len(rows):
            continue
        tried = whole.take(rows).of_quality(np.full(len(rows), other))
        found = identify_sample(tried, skies, known._replace(how=how), hopeless=True)[0]
        solved = np.flatnonzero(found.solved)
        solutions.enter_all(rows[solved], found, solved)
        quality[rows[solved]] = other
    return _settle_quality(whole, solutions, quality, skies, known)


def _settle_quality(
    whole: Sample, solutions: Solutions, quality: Array, skies: Skies, known: Known
) -> tuple[Solutions, Array]:
    """Return the solutions and each frame's errors over the sensor's, which depend on each
    other."""
    n, counts = len(quality), whole.spots.counts
    sky, frame = skies.sky(known.limit), np.repeat(np.arange(n), counts)
    for _ in range(QUALITY_ROUNDS):
        stars = np.bincount(frame, solutions.star >= 0, minlength=n)
        dof = np.where(solutions.solved, 2 * stars - 3, 0).astype(np.int64)
        chi2 = np.bincount(frame, np.where(solutions.star >= 0, solutions.chi2, 0.0), minlength=n)
        found = frame_scales(chi2 * quality**2, dof)
        if np.ptp(found) == 0.0 or np.abs(np.log(found / quality)).max() < SETTLED:
            break
        quality = found
        frames = whole.of_quality(quality).spots.frames(known.scale, known.use_flux)
        again = identify_again(whole.t_s, frames, solutions, sky, known.how)
        lost = np.flatnonzero(solutions.solved & ~again.solved)
        again.enter_all(lost, solutions, lost)
        solutions = again
    return solutions, quality

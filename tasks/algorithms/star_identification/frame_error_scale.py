"""Frames unlike the sensor's others: another brightness of the same stars, other errors."""

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.star_identification.frame_quality import frame_scales
from epipole.tasks.algorithms.star_identification.frames.centroids import Solutions
from epipole.tasks.algorithms.star_identification.sensor_sample import (
    Known,
    Sample,
    Skies,
    identify_sample,
)
from epipole.tasks.algorithms.star_identification.sequence import identify_again

Array = npt.NDArray[np.float64]

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

"""Frames that differ from the sensor's others: poor ones, and those of another brightness or error.

- `of_other_brightness`: unidentified frames may have another exposure or gain. They are searched
  with an unknown zero point.
- `reidentify_poor_frames`: of some identified frames far fewer centroids are stars than usual, for
  one of two reasons. The centroids are worse (the sensor turned or shook): only the few stars that
  happen to be near their predicted positions are matched, and the attitude has their error. Or the
  attitude is wrong: the images of bright stars that stay on a detector look like the frame before.
  So these frames are matched with larger errors, then their unmatched centroids are searched for
  another attitude. The solution with more evidence is taken.
- `by_quality`: each frame gets the centroid error that its residuals show. Unidentified frames are
  searched with the errors of the sensor's best and worst frames.
"""

import numpy as np

from epipole.schemas.arrays import Array, Integers
from epipole.tasks.algorithms.star_identification.centroids import SensorCentroids, Solutions
from epipole.tasks.algorithms.star_identification.frame import (
    FrameCentroids,
    MatchSettings,
    Solution,
    search_frame,
    some_centroids,
)
from epipole.tasks.algorithms.star_identification.search_budget import TOO_LITTLE_S, Allowance
from epipole.tasks.algorithms.star_identification.sensor_model import (
    SensorModel,
    Skies,
    frame_scales,
    rematch,
)
from epipole.tasks.algorithms.star_identification.sequence import (
    FrameSample,
    SensorSky,
    identify_again,
    identify_sample,
)
from epipole.tasks.algorithms.star_identification.star_grid import Sky

# Another brightness of the same stars.

# Frames that failed are tried in four further ways: with an unknown zero point, and with the three
# errors of `by_quality`. Each is one more chance of a false alarm.
OTHER_TRIALS = 4
MIN_CENTROIDS = 4  # of a frame that is tried
SHARE = 0.4  # of what is left of the searches' budget: what each pass here may cost


def of_other_brightness(
    frames: FrameSample, solutions: Solutions, skies: Skies, model: SensorModel
) -> Solutions:
    """Return the solutions with those of frames that have another zero point of brightness."""
    if not solutions.solved.any():
        return solutions
    matching = model.matching._replace(
        zero_point_mag=np.nan,
        threshold=model.matching.threshold + np.log(OTHER_TRIALS),
        crowded=False,
    )
    rows = np.flatnonzero(~solutions.solved & (frames.centroids.counts >= MIN_CENTROIDS))
    if model.use_flux and not np.isnan(model.matching.zero_point_mag) and len(rows):
        found = identify_sample(
            frames.take(rows), skies, model._replace(matching=matching), True, SHARE
        )[0]
        solved = np.flatnonzero(found.solved)
        solutions.enter_all(rows[solved], found, solved)
    return solutions


# Poor frames.

# A frame is poor if its share of stars among its centroids is below this part of the typical one.
# Measured (bench_unlike_frames): with 0.3, frames in which the sensor shook keep the errors of the
# others; with 1.2, more than half of the frames are poor, and one in sixty is identified wrong.
POOR = 0.6
MIN_FRAMES = 5  # minimum number of identified frames, for a typical share
MORE_STARS = 1.5  # larger errors are taken if at least this many times the stars match with them
MIN_GAIN = 3.0  # minimum gain in log evidence of another attitude
LARGER_ERRORS = (2.0, 4.0, 8.0, 16.0)  # factors on the errors that are tried
# Maximum number of rescalings of a frame's errors by its residuals, and the degrees of freedom that
# each needs.
RESCALINGS, MIN_DOF = 3, 5
# After more searches in a row than `PATIENCE` that gain nothing, 1, 3, 7 ... poor frames are not
# searched, at most 2^10 - 1.
PATIENCE, MAX_BACKOFF_LOG2 = 4, 10


def poor_frames(solutions: Solutions) -> Integers:
    """Return the identified frames of which far fewer centroids are stars than is usual."""
    counts = np.diff(solutions.first)
    frame = np.repeat(np.arange(len(counts)), counts)
    share = np.bincount(frame, solutions.star >= 0, minlength=len(counts)) / np.maximum(counts, 1)
    if solutions.solved.sum() < MIN_FRAMES:
        return np.empty(0, np.int64)
    return np.flatnonzero(solutions.solved & (share < POOR * np.median(share[solutions.solved])))


def reidentify_poor_frames(
    frames: SensorCentroids,
    solutions: Solutions,
    where: SensorSky,
    matching: MatchSettings,
    allowance: Allowance | None = None,
) -> Array:
    """Enter better solutions of poor frames; return (F,) factors on the errors of each frame.

    `solutions` are changed. `allowance` is what searches may cost.
    """
    factors = np.ones(len(solutions.solved))
    failures, skipped = 0, 0  # searches in a row that gained nothing; frames yet to be skipped
    for k in poor_frames(solutions).tolist():
        frame, known = frames.frame(k), solutions.frame(k)
        assert known is not None
        better = _with_larger_errors(frame, known, where.sky, matching)
        if better is None and skipped > 0:
            skipped -= 1
            continue
        if better is None:
            searching = matching._replace(crowded=False)
            if allowance is not None:
                left_s = allowance.left_s(k, (k + 1) / len(factors))
                searching = searching._replace(budget_s=left_s)
            if searching.budget_s < TOO_LITTLE_S:
                continue
            better, cost_s = _searched(frame, known, where, searching)
            if allowance is not None:
                allowance.spend(k, cost_s)
            failures = 0 if better else failures + 1
            skipped = 2 ** min(max(failures - PATIENCE, 0), MAX_BACKOFF_LOG2) - 1
        if better is not None:
            solution, factors[k] = better
            solutions.enter(k, solution)
    return factors


def _with_larger_errors(
    frame: FrameCentroids, known: Solution, sky: Sky, matching: MatchSettings
) -> tuple[Solution, float] | None:
    """Return the likeliest solution near the known one with larger errors, and the factor on these.

    None if it does not match clearly more stars.
    """
    tried = [(_near(frame, known, sky, matching, factor), factor) for factor in LARGER_ERRORS]
    more = [(found, factor) for found, factor in tried if found and _has_more_stars(found, known)]
    if not more:
        return None
    best, factor = max(more, key=lambda one: one[0].evidence)
    for _ in range(RESCALINGS):
        dof = 2 * _n_stars(best) - 3
        if dof < MIN_DOF:
            break
        by_residuals = max(factor * float(np.sqrt(best.chi2[best.star >= 0].sum() / dof)), 1.0)
        settled = _near(frame, best, sky, matching, by_residuals)
        if settled is None or not _has_more_stars(settled, known):
            break
        best, factor = settled, by_residuals
    return best, factor


def _near(
    frame: FrameCentroids, known: Solution, sky: Sky, matching: MatchSettings, factor: float
) -> Solution | None:
    """Return the solution near a known one with `factor` times the errors."""
    worse = frame._replace(sigma_rad=factor * frame.sigma_rad)
    return rematch([worse], [known], sky, matching)[0]


def _searched(
    frame: FrameCentroids, known: Solution, where: SensorSky, matching: MatchSettings
) -> tuple[tuple[Solution, float] | None, float]:
    """Return the solution of a search of the whole sky with the factor 1, None if it gains too
    little evidence; and what the search cost.

    Only unmatched centroids are searched: with all of them, the search would end with the known
    solution if that is beyond doubt.
    """
    unmatched = some_centroids(frame, np.flatnonzero(known.star < 0))
    searched = search_frame(unmatched, where.sky, where.grid, where.pairs(), matching)
    found = searched.solution and _near(frame, searched.solution, where.sky, matching, 1.0)
    if found is None:
        return None, searched.cost_s
    same = _near(frame, known, where.sky, matching, 1.0)  # judged as a search would
    if same is not None and found.evidence < same.evidence + MIN_GAIN:
        return None, searched.cost_s
    return (found, 1.0), searched.cost_s


def _has_more_stars(found: Solution, known: Solution) -> bool:
    return _n_stars(found) >= MORE_STARS * _n_stars(known)


def _n_stars(solution: Solution) -> int:
    return int(np.count_nonzero(solution.star >= 0))


# Other centroid errors.

# Maximum number of rounds in which the errors of the frames are learned; they end when no error
# changes by this in its logarithm.
QUALITY_ROUNDS, SETTLED = 6, 0.02
# Frames that failed are tried with the errors of the sensor's worst and best tenth, unless these
# are within a factor of `MIN_OTHER_ERROR` of the sensor's, and with errors larger by `MUCH_WORSE`.
MIN_OTHER_ERROR, MUCH_WORSE = 1.25, 8.0


def by_quality(
    frames: FrameSample, solutions: Solutions, quality: Array, skies: Skies, model: SensorModel
) -> tuple[Solutions, Array]:
    """Return the solutions with each frame's error, and (F,) these errors over the sensor's.

    Unidentified frames are searched as better and as worse ones.
    """
    solutions, quality = _settle_quality(frames, solutions, quality, skies, model)
    if not solutions.solved.any():
        return solutions, quality
    matching = model.matching._replace(
        threshold=model.matching.threshold + np.log(OTHER_TRIALS), crowded=False
    )
    for other in (*np.quantile(quality[solutions.solved], (0.9, 0.1)), MUCH_WORSE):
        rows = np.flatnonzero(~solutions.solved & (frames.centroids.counts >= MIN_CENTROIDS))
        if abs(np.log(other)) < np.log(MIN_OTHER_ERROR) or not len(rows):
            continue
        tried = frames.take(rows).of_quality(np.full(len(rows), other))
        found = identify_sample(tried, skies, model._replace(matching=matching), True, SHARE)[0]
        solved = np.flatnonzero(found.solved)
        solutions.enter_all(rows[solved], found, solved)
        quality[rows[solved]] = other
    return _settle_quality(frames, solutions, quality, skies, model)


def _settle_quality(
    frames: FrameSample, solutions: Solutions, quality: Array, skies: Skies, model: SensorModel
) -> tuple[Solutions, Array]:
    """Return the solutions, and each frame's errors over the sensor's; each follows from the other,
    so they are refined in turn."""
    n, counts = len(quality), frames.centroids.counts
    sky, frame = skies.sky(model.limit), np.repeat(np.arange(n), counts)
    for _ in range(QUALITY_ROUNDS):
        stars = np.bincount(frame, solutions.star >= 0, minlength=n)
        dof = np.where(solutions.solved, 2 * stars - 3, 0).astype(np.int64)
        chi2 = np.bincount(frame, np.where(solutions.star >= 0, solutions.chi2, 0.0), minlength=n)
        found = frame_scales(chi2 * quality**2, dof)
        if np.ptp(found) == 0.0 or np.abs(np.log(found / quality)).max() < SETTLED:
            break
        ratio2, quality = (found / quality) ** 2, found
        scaled = frames.of_quality(quality).scaled(model)
        again = identify_again(frames.t_s, scaled, solutions, sky, model.matching)
        lost = np.flatnonzero(solutions.solved & ~again.solved)
        again.enter_all(lost, solutions, lost)
        # The solutions of these are with the errors of the round before.
        again.cov_rad2[lost] *= ratio2[lost, None, None]
        at = np.isin(frame, lost)
        again.chi2[at] /= ratio2[frame[at]]
        solutions = again
    return solutions, quality

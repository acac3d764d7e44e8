"""What the published methods share: matches that agree, and a sensor's frames, each by itself.

A method says which star each centroid is. `agreeing_candidates` keeps those of its matches whose
separations in the image equal those in the catalogue. `identify_each_frame` computes the attitude
of each frame from its matches, without those that lie too far off: no evidence is weighed, no
frame is followed, no prior is used.
"""

from collections.abc import Callable

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices, Integers
from epipole.tasks.algorithms.geometry.attitude import optimal_attitude
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids, unsolved
from epipole.tasks.algorithms.star_identification.frame import (
    FieldOfView,
    FrameCentroids,
    MatchSettings,
    Solution,
    aberrate_all,
)
from epipole.tasks.algorithms.star_identification.search.pair_hypotheses import MAX_BETA
from epipole.tasks.algorithms.star_identification.sensor import (
    ASSUMED_IN_VIEW,
    MIN_CENTROIDS,
    IdentifiedSensor,
)
from epipole.tasks.algorithms.star_identification.sensor_model import Skies, scale_of
from epipole.tasks.algorithms.star_identification.star_grid import Sky


def chords(u: Array) -> Array:
    """Return (n, n) chords 2 sin(separation / 2) between (n, 3) unit vectors."""
    return np.linalg.norm(u[:, None] - u[None, :], axis=2)


def agreeing_candidates(
    u: Array, sigma_rad: Array, star_u: Array, centroid: Indices, star: Indices, gate_sigma: float
) -> Indices:
    """Return the largest set of candidate matches around one that agree with each other.

    Candidate k says that centroid[k] is star[k]. Its support is the number of centroids with a
    candidate whose separation from it is the same in image and catalogue. Kept are the candidate
    with most support, and those that agree with it and with half of the candidates that do, one
    star per centroid. Mirror images are refused.

    Parameters
    ----------
    u, sigma_rad : (n, 3), (n,) float
        Centroids' directions (sensor) and errors per axis [rad].
    star_u : (m, 3) float
        Catalogue directions (ICRS).
    centroid, star : (c,) int
        Candidates: rows of u and of star_u.
    gate_sigma
        Separations agree within this.

    Returns
    -------
    (n,) int64
        Each centroid's star, -1 without a match; all -1 with fewer than three matches.
    """
    matched = np.full(len(u), -1, np.int64)
    if len(centroid) < 3:
        return matched
    agree = _agree(u, sigma_rad, star_u, centroid, star, gate_sigma)
    support = _support(agree, centroid, len(u))
    best = int(np.argmax(support))
    with_best = agree[best].copy()
    with_best[best] = True
    rows = np.flatnonzero(with_best)
    inner = _support(agree[np.ix_(rows, rows)], centroid[rows], len(u))
    kept = inner >= 0.5 * (len(np.unique(centroid[rows])) - 1)
    rows, inner = rows[kept], inner[kept]
    for k in rows[np.lexsort((rows, -inner))]:
        if matched[centroid[k]] < 0 and star[k] not in matched:
            matched[centroid[k]] = star[k]
    at = np.flatnonzero(matched >= 0)
    if len(at) >= 3 and _same_hand(u[at], star_u[matched[at]]):
        return matched
    return np.full(len(u), -1, np.int64)


def _agree(
    u: Array, sigma_rad: Array, star_u: Array, centroid: Indices, star: Indices, gate_sigma: float
) -> Flags:
    """Return which candidates agree with each other, (c, c). Arguments as `agreeing_candidates`."""
    measured, listed = chords(u)[np.ix_(centroid, centroid)], chords(star_u[star])
    variance = sigma_rad[centroid] ** 2
    tolerance = gate_sigma * np.sqrt(variance[:, None] + variance) + MAX_BETA * measured
    other = (centroid[:, None] != centroid) & (star[:, None] != star)
    return other & (np.abs(measured - listed) < tolerance)


def _support(agree: Flags, centroid: Indices, n: int) -> Integers:
    """Return how many centroids have a candidate that agrees with each candidate."""
    of = np.zeros((len(centroid), n), np.float32)
    of[np.arange(len(centroid)), centroid] = 1.0
    return np.sum(agree.astype(np.float32) @ of > 0, axis=1)


def _same_hand(u: Array, s: Array) -> bool:
    """Return whether the set is not a mirror image.

    By the theorem of Cauchy and Binet, the determinant is the sum over all triples of the product
    of their triple products in image and catalogue.
    """
    return bool(np.linalg.det(u.T @ s) > 0.0)


# A sensor's frames, each by itself.

# Takes (n, 3) directions, brightest first, and (n,) sigmas [rad]; returns (n,) rows of the sky's
# catalogue, -1 where a centroid is not identified.
Matcher = Callable[[Array, Array], Indices]

ASSUMED_SIGMA_PX = 0.5  # of centroids without sigma, as in the published star maps


def solve_matches(
    frame: FrameCentroids, sky: Sky, star: Integers, gate_sigma: float
) -> Solution | None:
    """Return the attitude of a frame's matches; None where fewer than three agree with it."""
    star = star.copy()
    for _ in range(3):  # one wrong match bends the first attitude
        at = np.flatnonzero(star >= 0)
        if len(at) < 3:
            return None
        apparent = aberrate_all(sky.catalogue.u_icrs[star[at]], frame.beta)
        R, cov_rad2 = optimal_attitude(frame.u[at], apparent, frame.sigma_rad[at])
        chi2 = np.zeros(len(star))
        miss = np.linalg.norm(frame.u[at] - apparent @ R.T, axis=1)
        chi2[at] = (miss / frame.sigma_rad[at]) ** 2
        beyond = chi2 > gate_sigma**2
        if not beyond.any() and np.isfinite(cov_rad2).all():
            return Solution(R, cov_rad2, star, chi2, np.nan)
        star[beyond] = -1
    return None


def identify_each_frame(
    make_matcher: Callable[[Sky, FieldOfView], Matcher],
    centroids: RawCentroids,
    skies: Skies,
    magnitude_limit: float | None,
    matching: MatchSettings,
) -> IdentifiedSensor:
    """Identify the stars of a sensor's frames, each frame alone.

    Without `magnitude_limit`, the faintest star is the one that gives as many stars in a field
    as the frames have centroids. Where no errors are stated, 0.5 px is assumed, and the
    reported ones follow from the residuals.

    Parameters
    ----------
    make_matcher
        Prepares a method for a camera and its sky.
    """
    counts = centroids.counts
    usable = counts[counts >= MIN_CENTROIDS]
    if magnitude_limit is None:
        in_view = float(np.median(usable)) if len(usable) else ASSUMED_IN_VIEW
        magnitude_limit = skies.limit_for(in_view / centroids.optics[0].solid_angle_sr)
    sky = skies.sky(magnitude_limit)
    stated = bool(np.isfinite(centroids.sigma_px).any())
    match = make_matcher(sky, centroids.optics[0])
    assumed = np.where(np.isnan(centroids.sigma_px), ASSUMED_SIGMA_PX, centroids.sigma_px)
    frames, solutions = centroids._replace(sigma_px=assumed).frames(1.0), unsolved(centroids.first)
    for k in range(len(counts)):
        frame = frames.frame(k)
        solution = solve_matches(frame, sky, match(frame.u, frame.sigma_rad), matching.gate_sigma)
        if solution is not None:
            solutions.enter(k, solution)
    status = [_status(n, s) for n, s in zip(counts, solutions.solved, strict=True)]
    residuals, scale = scale_of(solutions.star, solutions.chi2, int(solutions.solved.sum())), 1.0
    if residuals.dof > 0 and not stated:
        scale = residuals.scale
        solutions = solutions.rescaled(scale)
    factor = scale if stated else scale * ASSUMED_SIGMA_PX
    return IdentifiedSensor(solutions, status, sky, np.full(len(status), factor))


def _status(n: int, solved: bool) -> str | None:
    if solved:
        return None
    if n < 3:
        return "too_few_stars" if n else "no_centroids"
    return "no_match"

"""Matches that agree with each other: separations in the image equal those in the catalogue."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Rows = npt.NDArray[np.int64]


def chords(u: Array) -> Array:
    """Return (n, n) chords 2 sin(separation / 2) between (n, 3) unit vectors."""
    return np.linalg.norm(u[:, None] - u[None, :], axis=2)


def agreeing_candidates(
    u: Array, sigma_rad: Array, star_u: Array, centroid: Rows, star: Rows, gate_sigma: float
) -> Rows:
    """Return the largest set of candidate matches around one that agree with each other.

    Candidate k says that centroid[k] is star[k]. Its support is the number of centroids with a
    candidate whose separation from it is the same in image and catalogue. Kept are the candidate
    with most support, and those that agree with it and with half of the candidates that do, one
    star per centroid. Mirror images are refused.

    Parameters
    ----------
    u, sigma_rad : (n, 3), (n,) float
        Centroids' directions (sensor) and errors an axis [rad].
    star_u : (m, 3) float
        Catalogue directions (ICRS).
    centroid, star : (c,) int
        Candidates: rows of u and of star_u.
    gate_sigma
        Separations agree within this.

    Returns
    -------
    (n,) int64
        Each centroid's star, -1 where it has none; all -1 with fewer than three matches.
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
    u: Array, sigma_rad: Array, star_u: Array, centroid: Rows, star: Rows, gate_sigma: float
) -> npt.NDArray[np.bool_]:
    measured, listed = chords(u)[np.ix_(centroid, centroid)], chords(star_u[star])
    variance = sigma_rad[centroid] ** 2
    # Aberration stretches by v / c at most.
    tolerance = gate_sigma * np.sqrt(variance[:, None] + variance) + 1.1e-4 * measured
    other = (centroid[:, None] != centroid) & (star[:, None] != star)
    return other & (np.abs(measured - listed) < tolerance)


def _support(agree: npt.NDArray[np.bool_], centroid: Rows, n: int) -> npt.NDArray[np.int64]:
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

"""Whether the sigmas of pairs, positions and states hold: chi-squares of a night."""

from typing import NamedTuple

import numpy as np

from epipole.io.datasets.night_tables import NightReader
from epipole.schemas.arrays import Array, Indices

PAIR_BINS = np.linspace(0.0, 5.0, 26)  # edges, in sigmas
MIN_BINS, MAX_BINS = 8, 40
FEW = 60  # fewer values make no bars that one could compare with a line


class Chi2(NamedTuple):
    """Chi-squares of one kind.

    edges, counts : (n + 1,) and (n,), histogram of the chi-squares; of pairs, that of the roots.
        The last bin also has what lies beyond it
    freedom : (m,), ``freedom[k]`` have k degrees of freedom
    total, freedoms : sums of the chi-squares and of the degrees of freedom
    independent : how many share no detection with each other
    few : the chi-squares themselves, in order, where they are fewer than `FEW`; else, and of pairs,
        empty
    """

    edges: Array
    counts: Indices
    freedom: Indices
    total: float
    freedoms: int
    independent: int
    few: Array

    @property
    def number(self) -> int:
        """How many there are."""
        return int(self.counts.sum())

    @property
    def mean(self) -> float:
        """The chi-square per degree of freedom: 1 where the sigmas hold."""
        return self.total / self.freedoms if self.freedoms else float("nan")


class SolvedChi2(NamedTuple):
    """Pair distances (in sigmas), and the chi-squares of positions and of states; None: no rows."""

    pairs: Chi2 | None
    positions: Chi2 | None
    states: Chi2 | None


def read_solved_chi2(night: NightReader) -> SolvedChi2:
    """Return the chi-squares of a night."""
    return SolvedChi2(_pairs(night), _positions(night), _states(night))


def _pairs(night: NightReader) -> Chi2 | None:
    counts, total, number = np.zeros(len(PAIR_BINS) - 1, np.int64), 0.0, 0
    for rows in night.pieces("pairs", ["mahalanobis"]):
        z = rows["mahalanobis"].to_numpy()
        z = z[np.isfinite(z)]
        counts += np.histogram(np.minimum(z, PAIR_BINS[-1]), PAIR_BINS)[0]
        total, number = total + float(z @ z), number + len(z)
    freedom, few = np.array([0, number]), np.empty(0)
    return Chi2(PAIR_BINS, counts, freedom, total, number, number, few) if number else None


def _positions(night: NightReader) -> Chi2 | None:
    freedom = np.zeros(1, np.int64)
    total, independent = 0.0, 0
    columns = ["n_sensors", "chi2", "independent"]
    for rows in night.pieces("positions", columns):
        dof = np.maximum(2 * rows["n_sensors"].to_numpy() - 3, 1)
        more = np.bincount(dof, minlength=len(freedom))
        freedom = more + np.pad(freedom, (0, len(more) - len(freedom)))
        total += float(rows["chi2"].sum())
        independent += int(rows["independent"].sum())
    if not freedom.sum():
        return None
    edges = _edges(freedom)
    counts = np.zeros(len(edges) - 1, np.int64)
    few = [np.empty(0)]
    for rows in night.pieces("positions", ["chi2"]):
        chi2 = rows["chi2"].to_numpy()
        counts += np.histogram(np.minimum(chi2, edges[-1]), edges)[0]
        few += [chi2] if freedom.sum() < FEW else []
    return _chi2(edges, counts, freedom, total, independent, np.concatenate(few))


def _states(night: NightReader) -> Chi2 | None:
    rows = night.read("states", ["chi2", "dof"])
    if not len(rows):
        return None
    freedom = np.bincount(np.maximum(rows["dof"].to_numpy(), 1))
    edges = _edges(freedom)
    chi2 = rows["chi2"].to_numpy()
    counts = np.histogram(np.minimum(chi2, edges[-1]), edges)[0]
    few = chi2 if len(rows) < FEW else np.empty(0)
    return _chi2(edges, counts, freedom, float(chi2.sum()), len(rows), few)


def _edges(freedom: Indices) -> Array:
    """Return bins as far as nearly all chi-squares should lie."""
    dof = int(np.searchsorted(np.cumsum(freedom), 0.95 * freedom.sum()))
    bins = int(np.clip(2 * np.sqrt(freedom.sum()), MIN_BINS, MAX_BINS))
    return np.linspace(0.0, dof + 4.5 * np.sqrt(2.0 * max(dof, 1)), bins + 1)


def _chi2(
    edges: Array, counts: Indices, freedom: Indices, total: float, independent: int, few: Array
) -> Chi2:
    freedoms = int(freedom @ np.arange(len(freedom)))
    return Chi2(edges, counts, freedom, total, freedoms, independent, np.sort(few))

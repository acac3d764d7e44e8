"""Chains of fragments: which continues which, each at most one, best as a whole."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

NONE = -1


class Fragments(NamedTuple):
    """Broken tracks of one sensor.

    offsets : (g + 1,) int64; fragment k has the detections offsets[k]:offsets[k + 1], in time
        order, at least one
    time_s, u_icrs, sigma_rad : (n,), (n, 3), (n,) float, times [s], unit vectors, and their
        1-sigma errors an axis [rad]
    """

    offsets: Indices
    time_s: Array
    u_icrs: Array
    sigma_rad: Array


class LinkRule(NamedTuple):
    """What the methods of linking are told; each takes what it needs.

    gap_s : longest gap that is bridged; infinite: as far as the method itself goes
    kept : share of true links that the chi-square test lets pass
    field_sr : solid angle in which fragments begin, for their density
    interval_s : the sensor's frame interval
    noise_rad2_s3 : process noise of a method that has one [rad^2/s^3]
    """

    gap_s: float
    kept: float
    field_sr: float
    interval_s: float
    noise_rad2_s3: float


class Links(NamedTuple):
    """For each fragment the one before it (-1: none), and the link's chi-square (NaN: none)."""

    before: Indices
    chi2: Array


def choose_links(earlier: Indices, later: Indices, gain: Array, chi2: Array, n: int) -> Links:
    """Return the links that gain most in sum; a fragment may stay alone.

    Parameters
    ----------
    earlier, later : (p,) int
        Fragments of each possible link, a pair at most once.
    gain, chi2 : (p,) float
        What the link is worth compared with leaving both ends open: links without gain are not
        made. And its test quantity, which is passed on.
    n
        Number of fragments.

    Notes
    -----
    An assignment on the matrix of gains, in which impossible links gain nothing. It has the same
    optimum as [[D, diag(c / 2)], [diag(c / 2), 0]] with gain = c - D, at a quarter of the size.
    Links that share no fragment, directly or through others, are assigned separately.
    """
    before, kept = np.full(n, NONE), np.full(n, np.nan)
    good = np.flatnonzero(gain > 0)
    if not len(good):
        return Links(before, kept)
    i, j = earlier[good], later[good]
    # An end and a start of one fragment are two things: columns come after the rows.
    graph = coo_array((np.ones(len(good)), (i, n + j)), shape=(2 * n, 2 * n))
    _, label = connected_components(graph, directed=False)
    group = label[i]
    order = np.argsort(group, kind="stable")
    bounds = np.flatnonzero(np.diff(group[order], prepend=-1, append=-1))
    size = np.diff(bounds)
    chosen = [order[bounds[:-1][size == 1]]]
    for lo, k in zip(bounds[:-1][size > 1], size[size > 1], strict=True):
        chosen.append(_assign(order[lo : lo + k], i, j, gain[good]))
    picked = good[np.concatenate(chosen)]
    before[later[picked]] = earlier[picked]
    kept[later[picked]] = chi2[picked]
    return Links(before, kept)


def leave_unlinked(fragments: Fragments, rule: LinkRule) -> Links:
    """Return no links: every fragment stays a track."""
    n = len(fragments.offsets) - 1
    return Links(np.full(n, NONE), np.full(n, np.nan))


def _assign(members: Indices, i: Indices, j: Indices, gain: Array) -> Indices:
    """Return the links of one group that gain most together."""
    rows, row = np.unique(i[members], return_inverse=True)
    columns, column = np.unique(j[members], return_inverse=True)
    matrix = np.zeros((len(rows), len(columns)))
    link = np.full(matrix.shape, NONE)
    matrix[row, column] = gain[members]
    link[row, column] = members
    taken = link[linear_sum_assignment(matrix, maximize=True)]
    return taken[taken != NONE]


def fill_in(links: Links, earlier: Indices, later: Indices, gain: Array, chi2: Array) -> Links:
    """Return the links, with lone fragments inserted where they fit both sides of a link.

    A link between two long fragments can outweigh the two links through a short fragment between
    them, as each long one predicts the other more precisely than the short one. The short one
    contradicts neither. Parameters as in `choose_links`.
    """
    n = len(links.before)
    before, kept = links.before.copy(), links.chi2.copy()
    good = np.flatnonzero(gain > 0)
    pair = {(int(earlier[p]), int(later[p])): p for p in good}
    while True:
        after = np.full(n, NONE)
        after[before[before != NONE]] = np.flatnonzero(before != NONE)
        alone = (before == NONE) & (after == NONE)
        inner = [
            (gain[p] + gain[pair[m, k]], p, pair[m, k])
            for p in good[alone[later[good]] & (after[earlier[good]] != NONE)]
            for m, k in [(int(later[p]), int(after[earlier[p]]))]
            if (m, k) in pair
        ]
        if not inner:
            return Links(before, kept)
        _, p, q = max(inner)
        for link in (p, q):
            before[later[link]], kept[later[link]] = earlier[link], chi2[link]


def chain_heads(before: Indices) -> Indices:
    """Return the first fragment of each fragment's chain; its own number where it is alone."""
    head = np.arange(len(before))
    linked = before != NONE
    head[linked] = before[linked]
    while True:
        further = head[head]
        if (further == head).all():
            return head
        head = further

"""Chains of fragments: which continues which, with the maximum total gain."""

from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from epipole.schemas.arrays import Array, Indices

NONE = -1


class Fragments(NamedTuple):
    """Broken tracks of one sensor.

    offsets : (g + 1,) int64; fragment k has the detections offsets[k]:offsets[k + 1], in time
        order, at least one
    time_s, u_icrs, sigma_rad : (n,), (n, 3), (n,) float, times [s], unit vectors, and their
        1-sigma errors per axis [rad]
    """

    offsets: Indices
    time_s: Array
    u_icrs: Array
    sigma_rad: Array


class LinkRule(NamedTuple):
    """Parameters of the linking methods; each method uses some of them.

    gap_s : longest gap that is bridged; infinite: the limit of the method
    confidence : of the chi-square test: share of true links that pass it
    field_sr : solid angle in which fragments begin, for their density
    interval_s : the sensor's frame interval
    noise_rad2_s3 : process noise, for methods with one [rad^2/s^3]
    """

    gap_s: float
    confidence: float
    field_sr: float
    interval_s: float
    noise_rad2_s3: float


class Links(NamedTuple):
    """For each fragment the one before it (-1: none), and the link's chi-square (NaN: none)."""

    before: Indices
    chi2: Array


def choose_links(earlier: Indices, later: Indices, gain: Array, chi2: Array, n: int) -> Links:
    """Return the links with the maximum total gain; a fragment may stay alone.

    Parameters
    ----------
    earlier, later : (p,) int
        Fragments of each possible link; pairs are distinct.
    gain, chi2 : (p,) float
        Gain of each link over leaving both ends open (links without gain are not made), and its
        chi-square, which is passed on.
    n
        Number of fragments.

    Notes
    -----
    This is an assignment on the matrix of gains, with zeros for impossible links. It has the same
    optimum as [[D, diag(c / 2)], [diag(c / 2), 0]] with gain = c - D, at a quarter of the size.
    Links that share no fragment, directly or through others, are assigned separately.
    """
    before, link_chi2 = np.full(n, NONE), np.full(n, np.nan)
    good = np.flatnonzero(gain > 0)
    if not len(good):
        return Links(before, link_chi2)
    i, j = earlier[good], later[good]
    # The end and the start of a fragment are two nodes: columns come after the rows.
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
    link_chi2[later[picked]] = chi2[picked]
    return Links(before, link_chi2)


def leave_unlinked(fragments: Fragments, rule: LinkRule) -> Links:
    """Return no links: every fragment stays a track."""
    n = len(fragments.offsets) - 1
    return Links(np.full(n, NONE), np.full(n, np.nan))


def _assign(members: Indices, i: Indices, j: Indices, gain: Array) -> Indices:
    """Return the links of one group with the maximum total gain."""
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
    before, link_chi2 = links.before.copy(), links.chi2.copy()
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
            return Links(before, link_chi2)
        _, p, q = max(inner)
        for link in (p, q):
            before[later[link]], link_chi2[later[link]] = earlier[link], chi2[link]


def chain_heads(before: Indices) -> Indices:
    """Return the first fragment of each fragment's chain; a lone fragment is a chain."""
    head = np.arange(len(before))
    linked = before != NONE
    head[linked] = before[linked]
    while True:
        further = head[head]
        if (further == head).all():
            return head
        head = further

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
        What the link is worth against leaving both ends open; a link without gain is not made.
        And its test quantity, which is passed on.
    n
        Number of fragments.

    Notes
    -----
    An assignment on the matrix of gains in which what cannot be linked gains nothing. It has
    the same optimum as [[D, diag(c / 2)], [diag(c / 2), 0]] with gain = c - D, at a quarter of
    the size. Links that share no fragment, directly or through others, are assigned apart.
    """
    before, found = np.full(n, NONE), np.full(n, np.nan)
    good = np.flatnonzero(gain > 0)
    if not len(good):
        return Links(before, found)
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
    found[later[picked]] = chi2[picked]
    return Links(before, found)


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
    """Return the links with fragments put in that stand alone inside a link and fit both sides.

    Two long fragments know of each other more than either does of a short one between them, so
    that the link past it can outweigh the two links through it; but it contradicts neither.
    Parameters as in `choose_links`.
    """
    n = len(links.before)
    before, found = links.before.copy(), links.chi2.copy()
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
            return Links(before, found)
        _, p, q = max(inner)
        for link in (p, q):
            before[later[link]], found[later[link]] = earlier[link], chi2[link]


def chain_heads(before: Indices) -> Indices:
    """Return, for each fragment, the first of its chain (itself where it stands alone)."""
    head = np.arange(len(before))
    linked = before != NONE
    head[linked] = before[linked]
    while True:
        further = head[head]
        if (further == head).all():
            return head
        head = further

"""Linking by likelihood: on ten fragments, the links are the best of all sets of links.

The evidence of each pair is computed once more with dense covariances, and no pair is left out by
a quick test.
"""

import itertools

import numpy as np
import pytest
from scipy.stats import chi2 as chi_square

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.tracking.linking.chains import (
    NONE,
    Fragments,
    LinkRule,
    choose_links,
    fill_in,
)
from epipole.tasks.algorithms.tracking.linking.likelihood_ratio import link_by_likelihood
from epipole.tasks.algorithms.tracking.sky_filter import acceleration, cubic_span, jerk

SIGMA = 4 * ARCSEC
KEPT, GAP_S, FIELD_SR = 0.9999, 60.0, np.radians(8.0) ** 2
RULE = LinkRule(gap_s=GAP_S, confidence=KEPT, field_sr=FIELD_SR, interval_s=1.0, noise_rad2_s3=0.0)
WIDE_RAD, WIDE_RAD_S = 0.05, 0.005  # priors that stand for "anywhere" and "at any rate"


def ten_fragments(seed, apart_arcsec):
    """Return fragments of three objects in three parts each, and a stray; which object each is.

    The objects pass close to each other: some links of different objects are likely too.
    """
    rng = np.random.default_rng(seed)
    centre = rng.normal(size=3)
    centre /= np.linalg.norm(centre)
    parts, who = [], []
    for k in range(4):
        at, rate = rng.normal(size=2) * apart_arcsec, np.array([35.0, 10.0]) + rng.normal(size=2)
        bend = rng.normal(size=2) * acceleration(40 * ARCSEC) / ARCSEC / 3
        begun = rng.integers(0, 8)
        for _ in range(3 if k < 3 else 1):
            t = begun + np.arange(rng.integers(2, 8)) + rng.uniform(0, 0.3)
            here = at + rate * (t[:, None] - 30) + bend * (t[:, None] - 30) ** 2 / 2
            parts.append((t, here * ARCSEC + rng.normal(size=here.shape) * SIGMA))
            who.append(k)
            begun = int(t[-1]) + rng.integers(4, 20)
    order = rng.permutation(len(parts))
    u = np.concatenate([centre + parts[k][1] @ tangent_basis(centre) for k in order])
    time_s = np.concatenate([parts[k][0] for k in order])
    offsets = np.cumsum([0] + [len(parts[k][0]) for k in order])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return Fragments(offsets, time_s, u, np.full(len(u), SIGMA)), np.array(who)[order]


def log_likelihood(t, xy, rate):
    """Return ln p and chi-square of positions (n, 2) [rad] on one motion, `t` (n,) [s].

    Value and rate are normal with wide priors, acceleration and jerk with those of the rate.
    """
    basis = np.vander(t, 4, increasing=True) / [1, 1, 2, 6]
    prior = np.array([WIDE_RAD, WIDE_RAD_S, acceleration(rate), jerk(rate)])
    cov = np.eye(len(t)) * SIGMA**2 + (basis * prior**2) @ basis.T
    misfit = np.sum(xy * np.linalg.solve(cov, xy))
    return -misfit / 2 - np.linalg.slogdet(2 * np.pi * cov)[1], misfit


def evidence(fragments, i, j):
    """Return the log-likelihood ratio of one motion against two, and its chi-square."""
    rows = [slice(*fragments.offsets[k : k + 2]) for k in (i, j)]
    t, u = fragments.time_s, fragments.u_icrs
    middle = [(r.start + r.stop) // 2 for r in rows]
    drift = (u[middle[1]] - u[middle[0]]) / (t[middle[1]] - t[middle[0]])
    centre = (t[rows[0].stop - 1] + t[rows[1].start]) / 2
    plane = tangent_basis((u[middle[0]] + u[middle[1]])[None])[0]
    plane /= np.linalg.norm(plane, axis=1, keepdims=True)
    both = np.r_[rows[0], rows[1]]
    xy = (u[both] - u[middle[0]] - drift * (t[both] - t[middle[0]])[:, None]) @ plane.T
    t, n, rate = t[both] - centre, rows[0].stop - rows[0].start, np.linalg.norm(drift)
    parts = [slice(None), slice(0, n), slice(n, None)]
    log_p, misfit = zip(*(log_likelihood(t[p], xy[p], rate) for p in parts), strict=True)
    ratio = log_p[0] - log_p[1] - log_p[2]
    # The one motion takes one wide prior, two motions take two.
    ratio -= np.log(2 * np.pi * WIDE_RAD**2) + np.log(2 * np.pi * WIDE_RAD_S**2)
    return ratio, misfit[0] - misfit[1] - misfit[2]


def rate_area(fragments):
    """Return the area [rad^2/s^2] over which the fragments' rates spread."""
    rates, variances = [], []
    for lo, hi in itertools.pairwise(fragments.offsets):
        t, u = fragments.time_s[lo:hi], fragments.u_icrs[lo:hi]
        if hi - lo > 1:
            rates.append(np.polyfit(t, u, 1)[0])
            half, rate = (t[-1] - t[0]) / 2, np.linalg.norm(u[-1] - u[0]) / (t[-1] - t[0])
            noise = SIGMA**2 / np.sum((t - t.mean()) ** 2)
            variances.append(noise + (acceleration(rate) * half) ** 2)
    return 4 * np.pi * (np.var(rates, axis=0).sum() / 2 + np.median(variances))


def gains(fragments):
    """Return the gain and the chi-square of each possible link (earlier, later), as two dicts."""
    begun = fragments.time_s[fragments.offsets[:-1]]
    ended = fragments.time_s[fragments.offsets[1:] - 1]
    gain, chi2, area = {}, {}, np.log(FIELD_SR * rate_area(fragments))
    for i, j in itertools.permutations(range(len(begun)), 2):
        if not 0.0 < begun[j] - ended[i] <= GAP_S:
            continue
        ratio, misfit = evidence(fragments, i, j)
        others = [np.sum((begun > ended[i]) & (begun <= t)) for t in (begun[j], ended[i] + GAP_S)]
        ratio -= np.log(others[0] * (np.log(others[1]) + np.euler_gamma + 0.5))
        # The priors determine acceleration and jerk: two degrees of freedom for each axis.
        if misfit <= chi_square.ppf(KEPT, 4) and ratio + area > 0:
            gain[i, j], chi2[i, j] = ratio + area, max(misfit, 0.0)
    return gain, chi2


def best_of_all(gain):
    """Return the set of links with the largest sum of gains in which each end has one link."""
    best, best_sum = [], 0.0

    def add(chosen, total, rest):
        nonlocal best, best_sum
        if total > best_sum:
            best, best_sum = chosen, total
        for k, (i, j) in enumerate(rest):
            left = [(a, b) for a, b in rest[k + 1 :] if a != i and b != j]
            add([*chosen, (i, j)], total + gain[i, j], left)

    add([], 0.0, list(gain))
    return best


def filled_in(links, gain):
    """Return the links with lone fragments in between, the one that gains most first."""
    links = list(links)
    while True:
        used = {k for link in links for k in link}
        between = [
            (gain[i, m] + gain[m, j], (i, m), (m, j), (i, j))
            for i, j in links
            for m in {k for link in gain for k in link} - used
            if (i, m) in gain and (m, j) in gain
        ]
        if not between:
            return links
        _, one, other, link = max(between)
        links.remove(link)
        links += [one, other]


def before_of(links, n):
    before = np.full(n, NONE)
    for i, j in links:
        before[j] = i
    return before.tolist()


@pytest.mark.parametrize("apart_arcsec", [20.0, 100.0, 1000.0])
@pytest.mark.parametrize("seed", range(6))
def test_the_links_of_ten_fragments_are_the_best_of_all_sets(seed, apart_arcsec):
    fragments, who = ten_fragments(seed, apart_arcsec)
    assert cubic_span(60 * ARCSEC, SIGMA) / 4 > 8.0  # no fragment is cut
    links = link_by_likelihood(fragments, RULE)
    gain, chi2 = gains(fragments)
    chosen = filled_in(best_of_all(gain), gain)
    assert links.before.tolist() == before_of(chosen, len(who))
    for i, j in chosen:
        assert links.chi2[j] == pytest.approx(chi2[i, j], abs=0.02)
    if apart_arcsec == 1000.0:
        assert all(who[i] == who[j] for i, j in chosen)
        assert len(chosen) > 2


@pytest.mark.parametrize("seed", range(40))
def test_any_links_are_chosen_and_filled_in_as_by_trying_all_sets(seed):
    rng = np.random.default_rng(seed)
    n = 8
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n) if rng.random() < 0.6]
    earlier, later = np.array(pairs).T
    # Long links gain more, so that fragments are left over between.
    gain = rng.normal(0.0, 2.0, len(pairs)) + 1.5 * (later - earlier)
    chi2 = rng.random(len(pairs))
    good = {pair: g for pair, g in zip(pairs, gain, strict=True) if g > 0}
    links = choose_links(earlier, later, gain, chi2, n)
    chosen = best_of_all(good)
    assert links.before.tolist() == before_of(chosen, n)
    links = fill_in(links, earlier, later, gain, chi2)
    chosen = filled_in(chosen, good)
    assert links.before.tolist() == before_of(chosen, n)
    for i, j in chosen:
        assert links.chi2[j] == chi2[pairs.index((i, j))]

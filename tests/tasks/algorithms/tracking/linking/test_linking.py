"""Track linking, both methods: fragments of one object are joined, others stay alone."""

import numpy as np
import pytest
from scenes.fragment_scenes import broken_tracks
from scenes.identity_score import identity_f1
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2 as chi_square

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.tracking.linking.chains import (
    NONE,
    Fragments,
    LinkRule,
    chain_heads,
    choose_links,
)
from epipole.tasks.algorithms.tracking.linking.likelihood_ratio import link_by_likelihood
from epipole.tasks.algorithms.tracking.linking.prediction import link_by_prediction
from epipole.tasks.algorithms.tracking.sky_filter import acceleration, jerk

SIGMA = 4 * ARCSEC


def rule(gap_s):
    return LinkRule(
        gap_s=gap_s,
        confidence=0.9999,
        field_sr=np.radians(8.0) ** 2,
        interval_s=1.0,
        noise_rad2_s3=1e-3 * (28 * ARCSEC) ** 2,
    )


def by_likelihood(*fragments, gap_s=90.0):
    return link_by_likelihood(Fragments(*fragments), rule(gap_s))


def by_prediction(*fragments, gap_s=90.0):
    return link_by_prediction(Fragments(*fragments), rule(gap_s))


METHODS = pytest.mark.parametrize("link", [by_likelihood, by_prediction])


def fragments(parts, seed=0, axis=(0.3, 0.5, 0.8), bend=(0.0, 0.0)):
    """Fragments of motions (place, rate, times), in arcsec about an axis, with noise."""
    rng = np.random.default_rng(seed)
    centre = np.array(axis) / np.linalg.norm(axis)
    basis = tangent_basis(centre)
    offsets, times, u = [0], [], []
    for place, rate, t in parts:
        t = np.asarray(t, float)
        spot = (
            np.array(place) + np.array(rate) * t[:, None] + 0.5 * np.array(bend) * t[:, None] ** 2
        )
        spot = spot * ARCSEC + rng.normal(size=(len(t), 2)) * SIGMA
        u.append(centre + spot @ basis)
        times.append(t)
        offsets.append(offsets[-1] + len(t))
    u = np.concatenate(u)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    return np.array(offsets), np.concatenate(times), u, np.full(len(u), SIGMA)


@METHODS
@pytest.mark.parametrize("axis", [(0.3, 0.5, 0.8), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)])
def test_three_fragments_of_one_object_chain(link, axis):
    motion = ((0.0, 0.0), (40.0, -10.0))
    parts = [(*motion, np.arange(lo, lo + 10)) for lo in (60, 0, 30)]
    links = link(*fragments(parts, axis=axis))
    assert links.before.tolist() == [2, NONE, 1]
    assert chain_heads(links.before).tolist() == [1, 1, 1]
    assert np.isnan(links.chi2).tolist() == [False, True, False]


@METHODS
def test_a_fragment_that_fits_nothing_stays_alone(link):
    parts = [
        ((0, 0), (40, 0), np.arange(10)),
        ((3000, 3000), (-40, 0), np.arange(20, 30)),
        ((0, 5000), (0, 40), np.arange(21, 31)),
    ]
    assert (link(*fragments(parts)).before == NONE).all()


@METHODS
def test_a_break_longer_than_the_longest_is_not_joined(link):
    parts = [((0, 0), (40, 0), np.arange(10)), ((0, 0), (40, 0), np.arange(40, 50))]
    assert link(*fragments(parts), gap_s=31.5).before.tolist() == [NONE, 0]
    assert link(*fragments(parts), gap_s=30.5).before.tolist() == [NONE, NONE]


@METHODS
def test_fragments_that_overlap_in_time_are_two_objects(link):
    parts = [((0, 0), (40, 0), np.arange(10)), ((0, 0), (40, 0), np.arange(9, 19))]
    assert (link(*fragments(parts)).before == NONE).all()


@METHODS
def test_the_better_of_two_candidates_is_joined_and_the_other_begins_anew(link):
    parts = [
        ((0, 0), (40, 0), np.arange(12)),
        ((0, 60), (40, 0), np.arange(20, 32)),
        ((0, 0), (40, 0), np.arange(20, 32)),
    ]
    links = link(*fragments(parts))
    assert links.before.tolist() == [NONE, NONE, 0]


@METHODS
@pytest.mark.parametrize("sizes", [[], [1], [2], [1, 1, 1]])
def test_few_detections_are_no_trouble(link, sizes):
    parts = [((100 * k, 0), (0, 0), np.arange(20 * k, 20 * k + n)) for k, n in enumerate(sizes)]
    if not parts:
        links = link(np.zeros(1, np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros(0))
    else:
        links = link(*fragments(parts))
    assert len(links.before) == len(sizes)


@METHODS
@pytest.mark.parametrize(("n_objects", "gap_s"), [(60, (10, 20)), (60, (30, 60)), (250, (30, 60))])
def test_broken_tracks_of_orbiting_objects_are_joined(link, n_objects, gap_s):
    scene = broken_tracks(5, n_objects, gap_s)
    links = link(*scene[:4])
    size = np.diff(scene.offsets)
    score = identity_f1(np.repeat(scene.truth, size), np.repeat(chain_heads(links.before), size))
    assert score >= 0.995


@pytest.mark.parametrize("seed", range(100, 103))
@pytest.mark.parametrize("belt", [True, False])
def test_gaps_of_minutes_are_bridged_as_the_evidence_allows(seed, belt):
    scene = broken_tracks(seed, 120, (100, 250), belt=belt, duration_s=700.0)
    links = by_likelihood(*scene[:4], gap_s=np.inf)
    size = np.diff(scene.offsets)
    score = identity_f1(np.repeat(scene.truth, size), np.repeat(chain_heads(links.before), size))
    assert score >= 0.99
    joined = np.flatnonzero(links.before != NONE)
    first, last = scene.offsets[:-1], scene.offsets[1:] - 1
    gap_s = scene.time_s[first[joined]] - scene.time_s[last[links.before[joined]]]
    assert len(joined) > 10
    assert gap_s.min() > 90.0
    assert (scene.truth[joined] == scene.truth[links.before[joined]]).all()


def test_without_a_longest_gap_the_method_of_prediction_keeps_its_own():
    parts = [((0, 0), (40, 0), np.arange(10)), ((0, 0), (40, 0), np.arange(110, 120))]
    assert by_prediction(*fragments(parts), gap_s=np.inf).before.tolist() == [NONE, NONE]
    assert by_prediction(*fragments(parts), gap_s=110.0).before.tolist() == [NONE, 0]


def test_a_fragment_that_could_be_anywhere_is_not_joined():
    # Single detections, ten minutes apart: no motion is known, nothing is predicted.
    parts = [((100 * k, 0), (0, 0), np.arange(600 * k, 600 * k + 1)) for k in range(4)]
    assert (by_likelihood(*fragments(parts), gap_s=np.inf).before == NONE).all()


def test_the_likelihood_statistic_has_its_degrees_of_freedom_where_two_are_one_object():
    # Motions drawn from the prior: then the mean is 4, two for each axis.
    rate = 40 * ARCSEC
    bend = acceleration(rate) / ARCSEC
    rng = np.random.default_rng(6)
    t = np.concatenate([np.arange(10), np.arange(25, 35)]) - 17.0
    found = []
    for seed in range(1000):
        a = rng.normal(size=2) * bend
        parts = [((0, 0), (40, 0), t[:10]), ((0, 0), (40, 0), t[10:])]
        found.append(by_likelihood(*fragments(parts, seed=seed, bend=a)).chi2[1])
    found = np.array(found)
    assert np.isfinite(found).mean() > 0.997  # `confidence` is 0.9999
    assert abs(np.nanmean(found) - 4.0) < 0.4  # 4 sigma of the mean is 0.36
    assert np.nanquantile(found, 0.99) < chi_square.ppf(0.99, 8)


def test_the_likelihood_statistic_does_not_depend_on_the_axes():
    one = [((0, 0), (40, 0), np.arange(10)), ((0, 0), (40, 0), np.arange(25, 35))]
    offsets, t, u, sigma = fragments(one)
    turn = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    turned = u @ turn.T
    np.testing.assert_allclose(
        by_likelihood(offsets, t, turned, sigma).chi2,
        by_likelihood(offsets, t, u, sigma).chi2,
        rtol=1e-5,
    )
    np.testing.assert_allclose(
        by_likelihood(offsets, t + 86000.0, u, sigma).chi2,
        by_likelihood(offsets, t, u, sigma).chi2,
        rtol=1e-5,
    )


def test_the_likelihood_statistic_is_that_of_least_squares():
    parts = [((0, 0), (40, 5), np.arange(12)), ((0, 0), (40, 5), np.arange(30, 44))]
    offsets, t, u, sigma = fragments(parts, seed=3)
    middle = u[6] + u[12 + 7]
    middle /= np.linalg.norm(middle)
    plane = u @ tangent_basis(middle).T
    centre = (t[11] + t[12]) / 2
    h = np.vander(t - centre, 4, increasing=True)
    rate = np.linalg.norm((u[19] - u[6]) / (t[19] - t[6]))
    bound = np.diag([0, 0, acceleration(rate) / 2, jerk(rate) / 6])
    prior = np.diag([0, 0, 1 / bound[2, 2], 1 / bound[3, 3]])[2:]

    def misfit(rows):
        A = np.vstack([h[rows] / SIGMA, prior])
        z = np.vstack([plane[rows] / SIGMA, np.zeros((2, 2))])
        scale = np.linalg.norm(A, axis=0)
        fit = np.linalg.lstsq(A / scale, z, rcond=None)[0]
        return np.sum((z - A / scale @ fit) ** 2)

    expected = misfit(slice(None)) - misfit(slice(0, 12)) - misfit(slice(12, None))
    # The prior acts on the motion without its straight drift, as here: lines are free.
    assert by_likelihood(offsets, t, u, sigma).chi2[1] == pytest.approx(max(expected, 0), abs=1e-3)


def test_choosing_links_equals_the_augmented_matrix():
    rng = np.random.default_rng(0)
    for _ in range(30):
        n, limit = 8, 10.0
        D = rng.uniform(0, 20, (n, n))
        D[rng.random((n, n)) < 0.5] = 1e9
        i, j = np.nonzero(limit > D)
        links = choose_links(i, j, limit - D[i, j], D[i, j], n)
        half = np.where(np.eye(n, dtype=bool), limit / 2, 1e9)
        big = np.block([[D, half], [half, np.zeros((n, n))]])
        rows, columns = linear_sum_assignment(big)
        expected = np.full(n, NONE)
        for row, column in zip(rows, columns, strict=True):
            if row < n and column < n:
                expected[column] = row
        assert links.before.tolist() == expected.tolist()


def test_idf1_agrees_with_motmetrics():
    motmetrics = pytest.importorskip("motmetrics")
    rng = np.random.default_rng(4)
    truth, found = rng.integers(-1, 6, 400), rng.integers(-1, 9, 400)
    found = np.where(rng.random(400) < 0.6, truth, found)
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    kept_truth, kept_found = [], []
    for lo in range(0, 400, 5):
        # A frame holds an object or a track at most once.
        rows = [
            k for k in range(lo, lo + 5)
            if truth[k] not in truth[lo:k] and found[k] not in found[lo:k]
        ]  # fmt: skip
        a, b = truth[rows], found[rows]
        same = np.where(np.eye(len(rows), dtype=bool), 0.0, np.nan)
        accumulator.update(a[a >= 0], b[b >= 0], same[a >= 0][:, b >= 0])
        kept_truth.append(a)
        kept_found.append(b)
    expected = motmetrics.metrics.create().compute(accumulator, metrics=["idf1"])["idf1"].iloc[0]
    got = identity_f1(np.concatenate(kept_truth), np.concatenate(kept_found))
    assert got == pytest.approx(expected, abs=1e-12)

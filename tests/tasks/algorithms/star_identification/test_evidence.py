"""The verdict on an attitude."""

import math

import numpy as np
import pytest
from scipy.special import gammainc

from epipole.tasks.algorithms.star_identification.evidence import (
    DENSITIES,
    REPORTED,
    MatchRule,
    chance_margin,
    choice_lost,
    choice_predicted,
    log_brightness_ratio,
    log_magnitude_density,
    match_evidence,
    median_zero_point,
)

SIGMA = 1e-4
AREA = 0.04
FLAT = log_magnitude_density(np.linspace(-2, 16, 10_000))


def _rule(zero_point):
    return MatchRule(3.7, FLAT, zero_point, 0.4, 11.5, 18.5)


def _evidence(star_of, chi2=0.0, n_stars=5, instrumental=None, magnitude=None, zero=math.nan):
    n = len(star_of)
    instrumental = np.full(n, np.nan) if instrumental is None else instrumental
    magnitude = np.full(n_stars, 5.0) if magnitude is None else magnitude
    return match_evidence(
        np.array(star_of), np.full(n, chi2), np.full(n, SIGMA), instrumental, magnitude,
        _rule(zero), float(n_stars), AREA,
    )  # fmt: skip


def test_the_evidence_of_three_matches_is_what_the_formula_gives():
    total, matches = _evidence([0, 1, -1, 4], chi2=2.0)
    one = math.log(AREA / (2 * math.pi * SIGMA**2)) - 1.0
    # n! / (n - k)!, the integral of 4 p^3 p^k (1 - p)^(m - k), and one false centroid, not four.
    ways = math.factorial(4) / (4 * math.factorial(6) * math.factorial(2) / math.factorial(9))
    ways *= (1 + 1) / (4 + 1)
    assert matches == 3
    assert total == pytest.approx(3 * one - math.log(ways))


def test_averaged_over_chance_the_evidence_is_below_one():
    # Markov's inequality rests on this: the mean of the evidence's exponential over random frames
    # with one star and up to six centroids, weighted by the prior, under the best assignment.
    rng = np.random.default_rng(0)
    side, sigma = math.sqrt(AREA), 0.01
    mean, weight = np.zeros(7), 1.0 / np.arange(1.0, 8.0)
    for n in range(1, 7):
        u = rng.uniform(0, side, (20_000, n, 2))
        d2 = np.sum((u - side / 2) ** 2, axis=2).min(axis=1) / sigma**2
        lone = match_evidence(
            np.where(np.arange(n) == 0, 0, -1), np.zeros(n), np.full(n, sigma),
            np.full(n, np.nan), np.array([5.0]), _rule(math.nan), 1.0, AREA,
        )[0]  # fmt: skip
        mean[n] = np.mean(np.exp(lone - 0.5 * d2))
    assert 0.5 < np.sum(mean * weight) / np.sum(weight) < 1.0


def test_right_brightness_adds_and_wrong_brightness_takes_away():
    assert log_brightness_ratio(0.0, 5.0, FLAT, 0.4) > 2.0
    assert log_brightness_ratio(3.0, 5.0, FLAT, 0.4) < -0.5
    magnitude = np.array([2.0, 3.0, 4.0, 5.0, 6.0])
    right, _ = _evidence([0, 1, 2, 3], instrumental=magnitude[:4] - 20.0, magnitude=magnitude)
    swapped, _ = _evidence([3, 2, 1, 0], instrumental=magnitude[:4] - 20.0, magnitude=magnitude)
    none, _ = _evidence([0, 1, 2, 3], magnitude=magnitude)
    assert swapped < none < right


def test_the_zero_point_is_the_median_and_needs_three_matches():
    magnitude = np.array([1.0, 2.0, 3.0, 4.0, 5.0])
    instrumental = np.array([-19.0, -18.0, -17.0, -10.0, -15.0])
    assert median_zero_point(np.arange(5), instrumental, magnitude) == 20.0
    assert math.isnan(median_zero_point(np.array([0, 1, -1, -1, -1]), instrumental, magnitude))


def test_choosing_among_all_attitudes_costs_their_number():
    P = np.diag([1e-8, 1e-8, 1e-6])
    cells = 8 * math.pi**2 / ((2 * math.pi) ** 1.5 * math.sqrt(1e-22))
    assert choice_lost(P) == pytest.approx(-math.log(cells))


def test_a_prediction_as_sharp_as_the_data_costs_little_and_being_off_costs_more():
    P, R0 = np.eye(3) * 1e-8, np.eye(3)
    near = choice_predicted(P, P, R0, R0)
    assert near == pytest.approx(-1.5 * math.log(2))
    off = np.array([[1.0, -1e-3, 0], [1e-3, 1.0, 0], [0, 0, 1.0]])  # 7 sigma of both
    assert choice_predicted(P, P, off, R0) == pytest.approx(near - 25.0, abs=0.01)


def test_the_density_of_magnitudes_integrates_to_one():
    density = np.exp(log_magnitude_density(np.random.default_rng(0).normal(6, 1, 1000)))
    assert np.sum(density) * 0.25 == pytest.approx(1.0)


def test_chance_needs_more_luck_for_few_matches_where_a_field_shows_many_stars():
    few_stars, many_stars = (
        [chance_margin(k, 12, in_view) for k in (3, 4, 5)] for in_view in (5.0, 30.0)
    )
    assert all(a + 2.0 < b for a, b in zip(few_stars, many_stars, strict=True))
    assert many_stars == sorted(many_stars, reverse=True)


def test_matches_of_all_centroids_are_the_likelier_by_chance():
    assert chance_margin(4, 4, 17.0) < chance_margin(4, 40, 17.0)


@pytest.mark.parametrize("k", [3, 4, 9, 30])
@pytest.mark.parametrize("in_view", [0.5, 6.0, 30.0, 200.0])
def test_the_margin_of_chance_is_that_of_the_formula_by_scipy(k, in_view):
    m = in_view * np.array(DENSITIES)
    prior = 4 * (k + 1) * (k + 2) * (k + 3) * np.mean(gammainc(k + 4, m) / m**4) * 41 / (41 - k)
    expected = 0.5 * np.log(2 * np.pi * (k - 1.5)) - np.log(prior) - REPORTED
    assert chance_margin(k, 40, in_view) == pytest.approx(expected, rel=1e-9)

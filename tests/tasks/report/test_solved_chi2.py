"""Chi-squares of positions and pairs: right sigmas give 1 per degree of freedom."""

import numpy as np
import pytest
from scenes.made_nights import filled, reader_of
from scipy.stats import chi2

from epipole.tasks.report.solved_chi2 import read_solved_chi2


def test_chi_squares_of_right_sigmas_are_one_per_degree_of_freedom():
    rng = np.random.default_rng(3)
    sensors = rng.integers(2, 6, 20_000)
    made = chi2.rvs(2 * sensors - 3, random_state=rng)
    night = reader_of({
        "positions": filled("positions", n_sensors=sensors, chi2=made),
        "pairs": filled("pairs", mahalanobis=np.abs(rng.standard_normal(20_000))),
    })  # fmt: skip
    found = read_solved_chi2(night)
    assert abs(found.positions.mean - 1) < 0.03
    assert abs(found.pairs.mean - 1) < 0.05
    assert found.states is None
    assert found.positions.number == found.pairs.number == 20_000
    assert found.positions.freedom[1] == (sensors == 2).sum()


def test_a_night_without_objects_has_none():
    assert read_solved_chi2(reader_of({})) == (None, None, None)


def test_a_state_of_thousands_of_views_counts_with_all_its_freedoms():
    many = filled("states", chi2=[9_000.0] * 40, dof=[9_000] * 40)
    assert read_solved_chi2(reader_of({"states": many})).states.mean == pytest.approx(1.0)


def test_a_few_values_are_kept_and_many_are_not():
    values = [3.0, 1.0, 2.0]
    few = filled("states", chi2=values, dof=[2] * 3)
    many = filled("positions", chi2=np.ones(60), n_sensors=[2] * 60)
    found = read_solved_chi2(reader_of({"states": few, "positions": many}))
    assert found.states.few.tolist() == [1.0, 2.0, 3.0]
    assert len(found.positions.few) == 0


def test_the_line_of_chi_squares_is_what_each_bar_should_be():
    """One degree of freedom has no highest density: the line stays in the picture all the same."""
    draw_sky = pytest.importorskip("epipole.tasks.report.draw_sky")
    rng = np.random.default_rng(5)
    sensors = rng.choice([2, 4], 5000, p=[0.3, 0.7])
    made = chi2.rvs(2 * sensors - 3, random_state=rng)
    night = reader_of({"positions": filled("positions", n_sensors=sensors, chi2=made)})
    figure = draw_sky.Figure()
    draw_sky.draw_chi2(figure, read_solved_chi2(night).positions, "positions")
    (axes,) = figure.axes
    (line,) = [patch for patch in axes.patches if patch.get_label() == "chi-square distribution"]
    expected, bars = (
        line.get_data().values,
        np.array([bar.get_height() for bar in axes.patches[:-1]]),
    )
    assert axes.get_ylim()[1] > expected.max()
    sigma = np.sqrt(expected / (5000 * np.diff(line.get_data().edges)))
    assert np.abs(bars - expected).max() < 4.5 * sigma.max()
    assert np.abs((bars - expected) / sigma).mean() < 1.1

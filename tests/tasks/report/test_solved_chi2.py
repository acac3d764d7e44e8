"""Chi-squares of positions and pairs: right sigmas give 1 per degree of freedom."""

import numpy as np
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

"""Sensor residuals: mean and scatter of few objects are those of many, on average."""

import numpy as np

from epipole.tasks.name.sensor_residuals import _of_sensor

ALONG_KM, ACROSS_KM = 2.0, 0.5
SIGMA_KM = np.array([1.0, 0.3])


def test_the_scatter_of_few_objects_is_that_of_many_on_average():
    rng, n = np.random.default_rng(1), 4000
    found = [
        _of_sensor("a", [ALONG_KM, ACROSS_KM] + rng.normal(size=(3, 2)) * SIGMA_KM)
        for _ in range(n)
    ]
    squares = np.array([[each.along_scatter_km, each.across_scatter_km] for each in found]) ** 2
    # The mean of n variances of three values has a relative sigma of sqrt(1 / n).
    np.testing.assert_allclose(squares.mean(axis=0), SIGMA_KM**2, rtol=4 / np.sqrt(n))
    mean = np.mean([each.along_km for each in found])
    assert abs(mean - ALONG_KM) < 4 * SIGMA_KM[0] / np.sqrt(3 * n)


def test_one_object_has_no_scatter():
    one = _of_sensor("a", np.array([[ALONG_KM, ACROSS_KM]]))
    assert (one.objects, one.along_km, one.across_km) == (1, ALONG_KM, ACROSS_KM)
    assert np.isnan([one.along_scatter_km, one.across_scatter_km]).all()
    assert str(one) == "a: along +2.00 km, across +0.50 km"

"""Trails: passages are followed to a fraction of an arcsecond, and errors in time are found."""

import numpy as np
import pytest
from scenes.passages_of_one import passages_of_one

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.tracking.trails import AlongMotion, along_motion, time_error

SIGMA_ARCSEC = 13.0
FASTEST = np.radians(0.1)


def motions(seed, n, seconds, rate_hz, sigma_arcsec, error_s=0.0):
    """The fast passages of n, each with its true directions; times are off by `error_s`."""
    rng = np.random.default_rng(seed)
    seen = passages_of_one(seed, n, seconds, rate_hz, sigma_arcsec, far=False)
    for k, (first, last) in enumerate(zip(seen.bounds[:-1], seen.bounds[1:], strict=True)):
        if np.linalg.norm(seen.true_w[k]) < FASTEST:
            continue
        time_s, u = seen.time_s[first:last], seen.u[first:last]
        w = np.gradient(u, time_s, axis=0)
        u = u + w * rng.normal(0.0, error_s, len(u))[:, None]
        u /= np.linalg.norm(u, axis=1, keepdims=True)
        yield along_motion(time_s, u), np.linalg.norm(seen.true_w[k])


def found(passages, sigma_arcsec=SIGMA_ARCSEC):
    together = [motion for motion, _ in passages]
    motion = AlongMotion(*(np.concatenate(each) for each in zip(*together, strict=True)))
    return time_error(motion, np.full(len(motion.free), (sigma_arcsec * ARCSEC) ** 2))


@pytest.mark.parametrize(("seconds", "rate_hz"), [(2, 4), (5, 4), (15, 2), (30, 4)])
def test_passages_are_followed(seconds, rate_hz):
    for motion, rate in motions(3, 200, seconds, rate_hz, 0.0):
        assert np.abs(motion.miss_rad).max() < 0.2 * ARCSEC
        assert np.interp(0.5, np.linspace(0, 1, len(motion.rate_rad_s)), motion.rate_rad_s) == (
            pytest.approx(rate, rel=0.02)
        )


@pytest.mark.parametrize("seconds", [2, 5])
def test_no_error_is_found_where_there_is_none(seconds):
    errors = [found(motions(seed, 6, seconds, 4, SIGMA_ARCSEC)) for seed in range(100)]
    assert np.count_nonzero(errors) <= 4  # 0.5 expected; more than 4: one in 6,000


@pytest.mark.parametrize("error_s", [2e-3, 5e-3])
def test_the_error_in_time_is_found(error_s):
    errors = [found(motions(seed, 40, 5, 4, SIGMA_ARCSEC, error_s)) for seed in range(20)]
    assert np.median(errors) == pytest.approx(error_s, rel=0.12)


def test_one_wrong_detection_shows_nothing():
    passages = list(motions(1, 40, 5, 4, SIGMA_ARCSEC))
    passages[3][0].miss_rad[4] += 2000 * ARCSEC
    assert found(passages) == 0.0


def test_without_passages_there_is_no_error():
    none = np.zeros(0)
    assert time_error(AlongMotion(np.zeros((0, 3)), none, none, none, none), none) == 0.0

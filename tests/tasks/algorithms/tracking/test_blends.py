"""Blends: the error of a common centroid is within the stated size; lone spots have none."""

import numpy as np
import pytest

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.covariances import centroid_covariance
from epipole.tasks.algorithms.tracking.blends import (
    BIN_PX,
    BLEND_PX,
    TrackedDetections,
    blend_variance,
    of_neighbour,
    resolved_px,
)

PIXEL = 70 * ARCSEC
SIGMA = 0.05 * PIXEL
APART = 1.5  # px: nearer spots are one centroid
TIMES = np.arange(0.0, 80.0, 0.5)


def passing(seed, miss_px=0.4, drift_px_s=0.06, fluxes=(40.0, 60.0)):
    """Return the tracklets of an object that another one passes, and what each centroid is off.

    While their spots are one, the second object's tracklets have no detection: it has one tracklet
    before and one after.
    """
    rng = np.random.default_rng(seed)
    first = np.column_stack([0.3 * TIMES, np.zeros(len(TIMES))])
    second = first + np.column_stack(
        [drift_px_s * (TIMES - 40.0), np.full(len(TIMES), miss_px * rng.uniform(0.5, 1.5))]
    )
    blended = np.hypot(*(second - first).T) < APART
    share = fluxes[1] / sum(fluxes)
    off = np.where(blended[:, None], share * (second - first), 0.0)
    before = ~blended & (TIMES < 40)
    after = ~blended & (TIMES > 40)
    places = [first + off, second[before], second[after]]
    times = [TIMES, TIMES[before], TIMES[after]]
    flux = [np.where(blended, sum(fluxes), fluxes[0])]
    flux += [np.full(m.sum(), fluxes[1]) for m in (before, after)]
    return _tracked(rng, times, places, flux), off, blended


def _tracked(rng, times, places, flux):
    xy = np.concatenate(places) * PIXEL + rng.normal(size=(sum(map(len, times)), 2)) * SIGMA
    u = np.column_stack([xy, np.ones(len(xy))])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    bounds = np.cumsum([0, *map(len, times)])
    noise = centroid_covariance(u, np.full(len(u), SIGMA))
    return TrackedDetections(bounds, np.concatenate(times), u, noise, np.concatenate(flux))


@pytest.mark.parametrize("seed", range(5))
def test_the_error_of_a_blend_is_of_the_stated_size(seed):
    tracked, off, blended = passing(seed)
    variance = blend_variance(tracked, TIMES, PIXEL)[: len(TIMES)]
    assert (variance[blended] > 0).all()
    normalised = np.sum((off[blended] * PIXEL) ** 2, axis=1) / variance[blended]
    assert (normalised < 2).all()
    assert normalised.mean() > 0.15


def test_spots_far_from_any_other_have_no_such_error():
    tracked, _, _ = passing(0, miss_px=6.0)
    assert (blend_variance(tracked, TIMES, PIXEL) == 0).all()


def test_images_blend_by_the_pixels_of_their_frame():
    tracked, _, blended = passing(0)
    late, fine = TIMES > 40, PIXEL / 100
    assert (blend_variance(tracked, TIMES, fine) == 0).all()
    np.testing.assert_array_equal(
        blend_variance(tracked, TIMES, np.full(len(TIMES), PIXEL)),
        blend_variance(tracked, TIMES, PIXEL),
    )
    mixed = blend_variance(tracked, TIMES, np.where(late, PIXEL, fine))[: len(TIMES)]
    assert (mixed[blended & late] > 0).all()
    assert (mixed[~late] == 0).all()


def test_an_object_that_goes_on_as_another_tracklet_is_no_neighbour():
    rng = np.random.default_rng(1)
    path = np.column_stack([0.3 * TIMES, np.zeros(len(TIMES))])
    half = len(TIMES) // 2
    parts = [slice(0, half), slice(half + 4, None)]
    tracked = _tracked(
        rng, [TIMES[p] for p in parts], [path[p] for p in parts], [TIMES[p] * 0 + 9 for p in parts]
    )
    assert (blend_variance(tracked, TIMES, PIXEL) == 0).all()


def test_half_of_the_separation_is_taken_where_fluxes_are_unknown():
    tracked, _, blended = passing(2)
    unknown = tracked._replace(flux=np.full(len(tracked.flux), np.nan))
    known = blend_variance(tracked, TIMES, PIXEL)[: len(TIMES)][blended]
    variance = blend_variance(unknown, TIMES, PIXEL)[: len(TIMES)][blended]
    # The share over the rest: 0.5 / 0.5 and 0.6 / 0.4.
    np.testing.assert_allclose(np.median(variance / known), (1 / 1.5) ** 2, rtol=1e-9)
    assert not of_neighbour(unknown, blend_variance(unknown, TIMES, PIXEL)).any()


def test_a_spot_too_faint_for_the_object_is_its_neighbours():
    tracked, _, blended = passing(3)
    variance = blend_variance(tracked, TIMES, PIXEL)
    assert not of_neighbour(tracked, variance).any()
    flux = tracked.flux.copy()
    flux[: len(TIMES)][blended] = 15.0  # a third, faint object
    faint = of_neighbour(tracked._replace(flux=flux), variance)
    np.testing.assert_array_equal(np.flatnonzero(faint), np.flatnonzero(blended))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("apart", [1.0, 1.5, 2.0])
def test_the_data_tell_below_which_separation_spots_are_one(seed, apart):
    rng = np.random.default_rng(seed)
    separation = 5.0 * np.sqrt(rng.uniform(size=2000))
    resolved = separation[(separation > apart) | (rng.uniform(size=2000) < 0.02)]
    pairs = np.histogram(resolved, np.arange(0, 2 * BLEND_PX + BIN_PX / 2, BIN_PX))[0]
    assert apart <= resolved_px(pairs) <= apart + 2 * BIN_PX


def test_few_pairs_do_not_tell():
    assert resolved_px(np.zeros(20, int)) == BLEND_PX

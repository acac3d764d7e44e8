"""Brightness: co-located satellites of unlike brightness stay apart; glints lose no detection."""

import numpy as np
import pytest
from scenes.co_located import follow, mixed, ring

from epipole.tasks.algorithms.tracking import runs
from epipole.tasks.algorithms.tracking.brightness import (
    MAX_CHI2,
    SIZE,
    begin_brightness,
    brightness_chi2,
    learn_brightness,
    log_flux,
)

SCENES = 6


def state_of(values):
    state = np.empty(SIZE)
    begin_brightness(state)
    for value in values:
        learn_brightness(state, value)
    return state


def scenes(apart_km, every_s, n_frames):
    return [ring(k, every_s, n_frames, apart_km=apart_km) for k in range(SCENES)]


def followed(scene, seed, scatter):
    """Return the tracks of a scene in which every other object is 0.7 brighter in ln(flux)."""
    t, offsets, u, who = scene
    value = 0.7 * (who % 2) + np.random.default_rng(seed).normal(size=len(who)) * scatter
    return follow(t, offsets, u, np.exp(value))


def wrong(track, who):
    """Return how many detections are not of the object that their track mostly is."""
    counts = [np.bincount(who[track == k]) for k in range(track.max() + 1)]
    return sum(int(count.sum() - count.max()) for count in counts)


def test_a_steady_object_shows_another_one_and_a_tumbling_one_hardly_does():
    rng = np.random.default_rng(1)
    steady = state_of(rng.normal(size=20) * 0.05)
    tumbling = state_of(rng.normal(size=20) * 0.8)
    assert brightness_chi2(steady, 0.7) > 8.0
    assert brightness_chi2(steady, 2.0) == MAX_CHI2
    assert brightness_chi2(tumbling, 0.7) < 3.0
    assert brightness_chi2(steady, 0.02) < 0.5


def test_an_unknown_flux_counts_nothing():
    assert brightness_chi2(state_of([]), 5.0) == 0.0
    assert brightness_chi2(state_of([0.0, 0.1]), np.nan) == 0.0
    np.testing.assert_array_equal(state_of([0.0, np.nan, 0.1]), state_of([0.0, 0.1]))
    np.testing.assert_array_equal(
        log_flux(np.array([1.0, 0.0, -2.0, np.nan, np.inf])), [0.0, *[np.nan] * 4]
    )


def test_a_slow_change_is_followed():
    state = state_of(np.linspace(0.0, 3.0, 100))
    assert brightness_chi2(state, 3.03) < 4.0


@pytest.mark.parametrize(("apart_km", "every_s", "n_frames"), [(3.0, 30.0, 20), (1.0, 2.0, 60)])
def test_co_located_satellites_of_unlike_brightness_are_rarely_mixed(apart_km, every_s, n_frames):
    these = scenes(apart_km, every_s, n_frames)
    alike = [follow(*scene[:3]) for scene in these]
    unlike = [followed(scene, k, 0.1) for k, scene in enumerate(these)]
    n_alike, n_unlike = (
        sum(mixed(track, scene[3]) for track, scene in zip(tracks, these, strict=True))
        for tracks in (alike, unlike)
    )
    assert n_alike > 20
    assert n_unlike < 0.3 * n_alike
    kept = [sum((track >= 0).sum() for track in tracks) for tracks in (alike, unlike)]
    assert kept[1] >= kept[0]


def test_what_is_mixed_at_the_beginning_is_exchanged_afterwards(monkeypatch):
    these = scenes(1.0, 2.0, 60)
    after = sum(wrong(followed(s, k, 0.1), s[3]) for k, s in enumerate(these))
    monkeypatch.setattr(runs, "_follow_and_retrace", runs._follow)
    before = sum(wrong(followed(s, k, 0.1), s[3]) for k, s in enumerate(these))
    assert before > 10
    assert after < 0.5 * before


def test_a_flux_that_means_nothing_loses_no_detection():
    these = scenes(14.0, 5.0, 40)
    steady = sum((followed(s, k, 0.1) >= 0).sum() for k, s in enumerate(these))
    glinting = sum((followed(s, k, 2.0) >= 0).sum() for k, s in enumerate(these))
    assert glinting >= 0.999 * steady

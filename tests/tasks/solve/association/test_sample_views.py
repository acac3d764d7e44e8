"""Samples of views: windows of time, a few instants, and poses of the sensors at them."""

import numpy as np
import pytest
from scenes.associations import START_NS, tables
from scenes.tracklet_scenes import Scene

from epipole.tasks.solve.association.sample_views import MOST_SAMPLES, SpanViews

SECOND_NS = 1_000_000_000
TIMES = np.arange(0.0, 120.0, 2.0)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(3, 3, times=TIMES).objects(2)


@pytest.fixture(scope="module")
def views(scene) -> SpanViews:
    rows, *others = tables(scene)
    return SpanViews(rows.sort_by("epoch"), *others)


def test_windows_hold_every_row_once_in_order(views):
    windows = views.windows(30.0)
    assert np.concatenate(windows).tolist() == list(range(len(views.epoch_ns)))
    for rows in windows:
        assert len(set(views.epoch_ns[rows] // (30 * SECOND_NS))) == 1
    assert len(windows) == 4


def test_no_views_have_no_windows(scene):
    rows, *others = tables(scene)
    assert SpanViews(rows.slice(0, 0), *others).windows(30.0) == []


def test_even_instants_are_epochs_that_share_no_detections(views):
    window_s = 6.0
    instants = views.even_instants(np.arange(len(views.epoch_ns)), window_s)
    assert np.isin(instants, views.epoch_ns).all()
    assert 2 <= len(instants) <= MOST_SAMPLES
    assert np.diff(instants).min() >= 2 * window_s * SECOND_NS


def test_a_tracklet_between_the_even_instants_adds_one_of_its_epochs():
    scene = Scene(3, 2, times=TIMES).objects(2)
    scene.seen[0] = (TIMES > 15) & (TIMES < 19)
    rows, *others = tables(scene)
    views = SpanViews(rows.sort_by("epoch"), *others)
    everything = np.arange(len(views.epoch_ns))
    even, chosen = (f(everything, 30.0) for f in (views.even_instants, views.instants))
    of_tracklet = views.epoch_ns[views.tracklet == 0]
    assert not np.isin(of_tracklet, even).any()
    assert np.isin(of_tracklet, chosen).sum() == 1
    assert set(even.tolist()) < set(chosen.tolist())


def test_samples_have_the_views_at_the_instants(scene, views):
    instants = START_NS + (np.array([10.0, 40.0, 80.0]) * SECOND_NS).astype(np.int64)
    samples, tracklet = views.samples(np.arange(len(views.epoch_ns)), instants, 6.0)
    assert tracklet.tolist() == list(range(6))
    assert samples.seen.all()
    at = np.searchsorted(TIMES, [10.0, 40.0, 80.0])
    np.testing.assert_allclose(samples.u, np.array(scene.u)[:, at], atol=1e-12)
    np.testing.assert_allclose(samples.sensor_km, scene.r[:, at], atol=1e-9)
    np.testing.assert_array_equal(samples.sensor, scene.sensor)


def test_an_error_that_all_frames_share_counts_once_in_any_number_of_samples(scene):
    rows, *others = tables(scene)
    for name in ("cov_bias_11_rad2", "cov_bias_22_rad2"):
        at = rows.schema.get_field_index(name)
        rows = rows.set_column(at, rows.schema.field(at), rows["cov_noise_11_rad2"])
    views = SpanViews(rows.sort_by("epoch"), *others)
    everything = np.arange(len(views.epoch_ns))
    for n in (1, 4):
        samples, _ = views.samples(everything, START_NS + np.arange(n) * 20 * SECOND_NS, 6.0)
        noise = views.noise[0, 0, 0]
        np.testing.assert_allclose(samples.cov[:, :, 0, 0], (1 + n) * noise)
        sigma_km = views.sigma_km[0]
        np.testing.assert_allclose(samples.sigma_km, np.sqrt(n) * sigma_km)


def test_samples_that_share_detections_count_together_as_what_is_independent(views):
    everything, noise, window_s = np.arange(len(views.epoch_ns)), views.noise[0, 0, 0], 6.0
    apart = START_NS + np.arange(6) * 12 * SECOND_NS
    near = START_NS + np.arange(6) * 2 * SECOND_NS  # in less time than one window
    weight = [
        np.sum(1 / views.samples(everything, instants, window_s)[0].cov[:, :, 0, 0], axis=1)
        for instants in (apart, near)
    ]
    np.testing.assert_allclose(weight[0], 6 / noise)
    assert (weight[1] > 1 / noise).all()
    assert (weight[1] < 2 / noise).all()


def test_views_that_may_be_blends_are_not_sampled(scene):
    rows, *others = tables(scene)
    rows = rows.sort_by([("tracklet_id", "ascending"), ("epoch", "ascending")])
    doubtful = np.arange(rows.num_rows) < len(TIMES) // 2  # of the first tracklet
    noise = rows["cov_noise_11_rad2"].to_numpy()
    blend = np.where(doubtful, 100 * noise, 0.0)
    columns = {f"cov_noise_{axis}_rad2": noise + blend for axis in ("11", "22")}
    for name, values in (columns | {"blend_rad2": blend}).items():
        at = rows.schema.get_field_index(name)
        rows = rows.set_column(at, rows.schema.field(at), [values])
    views = SpanViews(rows.sort_by("epoch"), *others)
    instants = START_NS + np.array([10, 100]) * SECOND_NS
    samples, _ = views.samples(np.arange(len(views.epoch_ns)), instants, 6.0)
    assert samples.seen.tolist() == [[False, True]] + [[True, True]] * 5


def test_a_sensor_without_a_frame_near_an_instant_has_no_pose_there(scene):
    rows, tracklets, solutions, cameras = tables(scene)
    near = solutions["frame_number"].to_numpy() < 30  # until 58 s
    views = SpanViews(rows.sort_by("epoch"), tracklets, solutions.filter(near), cameras)
    instants = START_NS + np.array([10, 100]) * SECOND_NS
    samples, _ = views.samples(np.arange(len(views.epoch_ns)), instants, 6.0)
    known = np.isfinite(samples.R_sensor_from_icrs).all(axis=(2, 3))
    assert known.tolist() == [[True, False]] * 3

"""Samples of views: a few instants, their errors, and poses of the sensors at them."""

import numpy as np
import pyarrow as pa
import pytest
from scenes.associations import START_NS, SceneTables, block_of, tables
from scenes.tracklet_scenes import Scene

from epipole.schemas.bridge import array
from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.solve.association_input import SampledViews

SECOND_NS = 1_000_000_000
TIMES = np.arange(0.0, 120.0, 2.0)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(3, 3, times=TIMES).objects(2)


def at(*seconds: float) -> np.ndarray:
    return START_NS + (np.array(seconds) * SECOND_NS).astype(np.int64)


def samples_of(
    of: SceneTables, instants: np.ndarray, skipped: tuple[int, ...] = ()
) -> tuple[Samples, np.ndarray]:
    sampled = SampledViews(block_of(of), instants)
    return sampled.samples(instants, np.array(skipped, np.int64))


def with_columns(of: SceneTables, **columns) -> SceneTables:
    rows = of.views
    for name, values in columns.items():
        k = rows.schema.get_field_index(name)
        field = rows.schema.field(k)
        rows = rows.set_column(k, field, pa.array(values).cast(field.type))
    return of._replace(views=rows)


def test_samples_have_the_views_at_the_instants(scene):
    samples, tracklet = samples_of(tables(scene), at(10.0, 40.0, 80.0))
    assert tracklet.tolist() == list(range(6))
    assert samples.seen.all()
    rows = np.searchsorted(TIMES, [10.0, 40.0, 80.0])
    np.testing.assert_allclose(samples.u, np.array(scene.u)[:, rows], atol=1e-12)
    np.testing.assert_allclose(samples.sensor_km, scene.r[:, rows], atol=1e-9)
    np.testing.assert_array_equal(samples.sensor, scene.sensor)


def test_samples_of_some_of_the_instants_are_the_same_as_if_only_these_were_read(scene):
    instants = at(10.0, 40.0, 80.0)
    more, _ = SampledViews(block_of(tables(scene)), instants).samples(
        instants[:2], np.zeros(0, np.int64)
    )
    alone, _ = samples_of(tables(scene), instants[:2])
    for name in Samples._fields:
        np.testing.assert_array_equal(getattr(more, name), getattr(alone, name), name)


def test_views_of_skipped_sensors_are_no_samples(scene):
    samples, tracklet = samples_of(tables(scene), at(10.0, 40.0), skipped=(1,))
    others = np.flatnonzero(np.array(scene.sensor) != 1)
    assert tracklet.tolist() == others.tolist()
    assert samples.sensor.tolist() == [0, 2] * 2
    assert samples.sensor_km.shape[0] == 3  # where it is and looks is known


def test_an_error_that_all_frames_share_counts_once_in_any_number_of_samples(scene):
    of = tables(scene)
    noise = of.views["cov_noise_11_rad2"].to_numpy()
    of = with_columns(of, cov_bias_11_rad2=noise, cov_bias_22_rad2=noise)
    sigma_km = of.views["position_sigma_km"][0].as_py()
    for n in (1, 4):
        samples, _ = samples_of(of, at(*(np.arange(n) * 20.0)))
        np.testing.assert_allclose(samples.cov[:, :, 0, 0], (1 + n) * noise[0])
        np.testing.assert_allclose(samples.sigma_km, np.sqrt(n) * sigma_km)


def test_samples_that_share_detections_count_together_as_what_is_independent(scene):
    of = tables(scene)
    noise = of.views["cov_noise_11_rad2"][0].as_py()
    epoch = of.views["epoch"].cast("int64").to_numpy()
    half = 6_000_000_000
    of = with_columns(of, first_fitted=epoch - half, last_fitted=epoch + half)
    apart, near = at(*(np.arange(6) * 12.0)), at(*(np.arange(6) * 2.0))  # less than one window
    weight = [
        np.sum(1 / samples_of(of, instants)[0].cov[:, :, 0, 0], axis=1)
        for instants in (apart, near)
    ]
    np.testing.assert_allclose(weight[0], 6 / noise)
    assert (weight[1] > 1 / noise).all()
    assert (weight[1] < 2 / noise).all()


def test_views_that_may_be_blends_are_not_sampled(scene):
    of = tables(scene)
    rows = of.views.sort_by([("tracklet_id", "ascending"), ("epoch", "ascending")])
    doubtful = np.arange(rows.num_rows) < len(TIMES) // 2  # of the first tracklet
    noise = rows["cov_noise_11_rad2"].to_numpy()
    blend = np.where(doubtful, 100 * noise, 0.0)
    columns = {f"cov_noise_{axis}_rad2": noise + blend for axis in ("11", "22")}
    of = with_columns(of._replace(views=rows), **columns, blend_rad2=blend)
    samples, _ = samples_of(of, at(10.0, 100.0))
    assert samples.seen.tolist() == [[False, True]] + [[True, True]] * 5


def test_a_sensor_without_a_frame_near_an_instant_has_no_pose_there(scene):
    of = tables(scene)
    near = of.solutions["frame_number"].to_numpy() < 30  # until 58 s
    samples, _ = samples_of(of._replace(solutions=of.solutions.filter(near)), at(10.0, 100.0))
    known = np.isfinite(samples.R_sensor_from_icrs).all(axis=(2, 3))
    assert known.tolist() == [[True, False]] * 3


def test_a_tracklet_s_magnitude_is_the_mean_of_those_of_its_views(scene):
    of = tables(scene)
    first = array(of.views, "tracklet_id") == of.views["tracklet_id"][0].as_py()
    magnitude = np.where(first, np.arange(len(first)) / 10, np.nan)
    seen_twice, unknown = (
        samples_of(
            with_columns(of, magnitude=pa.array(values, mask=np.isnan(values))), at(10.0, 40.0)
        )
        for values in (magnitude, np.full(len(first), np.nan))
    )
    rows = np.searchsorted(TIMES, [10.0, 40.0])
    np.testing.assert_allclose(seen_twice[0].magnitude[0], magnitude[first][rows].mean())
    assert np.isnan(seen_twice[0].magnitude[1:]).all()
    assert np.isnan(unknown[0].magnitude).all()

"""Choose instants: a few epochs that share no detections, and one for each short tracklet."""

import numpy as np
from scenes.associations import block_of, filled, tables
from scenes.tracklet_scenes import Scene

from epipole.schemas.settings import AlignmentSettings, AssociationSettings, Settings
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.solve.association_input import (
    MAX_SAMPLES,
    clear_views,
    even_instants,
    with_extra_instants,
)

SECOND_NS = 1_000_000_000
TIMES = np.arange(0.0, 120.0, 2.0)


def test_even_instants_are_epochs_that_share_no_detections():
    epochs, window_s = block_of(tables(Scene(3, 3, times=TIMES).objects(2))).epochs, 6.0
    instants = even_instants(epochs, window_s)
    assert np.isin(instants, epochs).all()
    assert 2 <= len(instants) <= MAX_SAMPLES
    assert np.diff(instants).min() >= 2 * window_s * SECOND_NS


def test_no_epochs_have_no_instants_and_few_have_one():
    assert len(even_instants(np.zeros(0, np.int64), 6.0)) == 0
    assert even_instants(np.array([5, 7, 9]) * SECOND_NS, 6.0).tolist() == [7 * SECOND_NS]


def test_long_windows_have_no_more_than_the_most_instants():
    assert len(even_instants(np.arange(600) * SECOND_NS, 6.0)) == MAX_SAMPLES


def test_a_tracklet_between_the_even_instants_adds_one_of_its_epochs():
    scene = Scene(3, 2, times=TIMES).objects(2)
    scene.seen[0] = (TIMES > 15) & (TIMES < 19)
    of = tables(scene)
    settings = Settings(
        association=AssociationSettings(span_s=600.0), alignment=AlignmentSettings(window_s=30.0)
    )
    block = block_of(of, settings)
    (chosen,) = block.instants
    even = even_instants(block.epochs, 30.0)
    of_tracklet = of.views.filter(np.array(of.views["tracklet_id"]) == "t0000")
    of_tracklet = of_tracklet["epoch"].cast("int64").to_numpy()
    assert not np.isin(of_tracklet, even).any()
    assert np.isin(of_tracklet, chosen).sum() == 1
    assert set(even.tolist()) < set(chosen.tolist())


def test_two_tracklets_share_an_extra_instant():
    even = np.array([10, 50])
    chosen = with_extra_instants(even, [np.array([20, 21, 22]), np.array([21, 30, 31])])
    assert chosen.tolist() == [10, 21, 50]
    apart = with_extra_instants(even, [np.array([20, 21, 22]), np.array([30, 31])])
    assert apart.tolist() == [10, 21, 31, 50]


def test_extra_instants_are_limited():
    tracklets = [np.array([1000 + k]) for k in range(2 * MAX_SAMPLES)]
    chosen = with_extra_instants(np.array([10, 50]), tracklets)
    assert chosen.tolist() == [10, 50, *range(1000, 1000 + MAX_SAMPLES - 2)]


def test_a_tracklet_that_is_a_blend_throughout_adds_no_instant():
    assert with_extra_instants(np.array([10]), [np.zeros(0, np.int64)]).tolist() == [10]


def test_views_are_clear_where_a_neighbour_adds_little_to_their_errors():
    blend = np.array([0.0, 1.0, 100.0, 100.0])
    shared = np.array([0.0, 0.0, 0.0, 100.0])
    views = filled(VIEWS, 4, {
        "blend_rad2": blend,
        **{f"cov_noise_{ab}_rad2": 1.0 + blend for ab in ("11", "22")},
        **{f"cov_bias_{ab}_rad2": shared for ab in ("11", "22")},
    })  # fmt: skip
    assert clear_views(views).tolist() == [True, True, False, True]

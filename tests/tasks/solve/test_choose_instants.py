"""Choose instants: a few epochs that share no detections, and the ends of short tracklets."""

import numpy as np
from scenes.associations import block_of, filled, tables
from scenes.tracklet_scenes import Scene

from epipole.schemas.settings import AlignmentSettings, AssociationSettings, Settings
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.solve.association_input import (
    MAX_ENDS,
    MAX_SAMPLES,
    clear_views,
    even_instants,
    with_ends,
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


def test_a_tracklet_between_the_even_instants_adds_its_ends():
    scene = Scene(3, 2, times=TIMES).objects(2)
    scene.seen[0] = (TIMES > 15) & (TIMES < 21)
    of = tables(scene)
    settings = Settings(
        association=AssociationSettings(window_s=600.0), alignment=AlignmentSettings(window_s=30.0)
    )
    block = block_of(of, settings)
    (chosen,) = block.instants
    even = even_instants(block.epochs, 30.0)
    of_tracklet = of.views.filter(np.array(of.views["tracklet_id"]) == "t0000")
    of_tracklet = of_tracklet["epoch"].cast("int64").to_numpy()
    assert not np.isin(of_tracklet, even).any()
    assert chosen.tolist() == sorted([*even, of_tracklet[0], of_tracklet[-1]])


EPOCHS = np.arange(0, 30 * SECOND_NS, SECOND_NS // 2)


def at(*seconds):
    return np.array([round(s * SECOND_NS) for s in seconds])


def test_two_tracklets_are_compared_at_both_ends_of_the_time_they_share():
    rng = np.random.default_rng(0)
    for _ in range(200):
        first = rng.choice(EPOCHS[:40], 2)
        last = first + rng.choice(EPOCHS[3:20], 2)
        chosen = with_ends(at(7.5, 22.5), EPOCHS, first, last)
        begin, end = first.max(), last.min()
        if end - begin >= 2 * SECOND_NS:
            shared = chosen[(chosen >= begin) & (chosen <= end)]
            assert shared[0] - begin < SECOND_NS
            assert end - shared[-1] < SECOND_NS


def test_a_tracklet_shorter_than_the_step_has_one_instant():
    assert with_ends(at(7.5), EPOCHS, at(10.5), at(10.5)).tolist() == at(7.5, 10.5).tolist()


def test_ends_are_few_however_many_tracklets_there_are():
    rng = np.random.default_rng(1)
    first = rng.choice(EPOCHS[:40], 5000)
    assert len(with_ends(at(7.5, 22.5), EPOCHS, first, first + 3 * SECOND_NS)) <= 32


def test_a_long_window_has_no_more_ends_than_a_short_one():
    epochs = np.arange(0, 600 * SECOND_NS, SECOND_NS)
    first = np.random.default_rng(2).choice(epochs[:-60], 5000)
    chosen = with_ends(even_instants(epochs, 6.0), epochs, first, first + 50 * SECOND_NS)
    assert len(chosen) <= MAX_SAMPLES + MAX_ENDS + 1


def test_without_tracklets_the_even_instants_stay():
    none = np.zeros(0, np.int64)
    assert with_ends(at(7.5, 22.5), EPOCHS, none, none).tolist() == at(7.5, 22.5).tolist()


def test_views_are_clear_where_a_neighbour_adds_little_to_their_errors():
    blend = np.array([0.0, 1.0, 100.0, 100.0])
    shared = np.array([0.0, 0.0, 0.0, 100.0])
    views = filled(VIEWS, 4, {
        "blend_rad2": blend,
        **{f"cov_noise_{ab}_rad2": 1.0 + blend for ab in ("11", "22")},
        **{f"cov_bias_{ab}_rad2": shared for ab in ("11", "22")},
    })  # fmt: skip
    assert clear_views(views).tolist() == [True, True, False, True]

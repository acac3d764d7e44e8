"""Block views: each tracklet in each window once, and the views at some epochs."""

import numpy as np
import pytest
from scenes.associations import SPAN, START_NS, block_of, sensor_views, tables
from scenes.tracklet_scenes import Scene

from epipole.schemas.bridge import array
from epipole.schemas.spans import Span
from epipole.tasks.solve.association_input import BlockViews

SECOND_NS = 1_000_000_000
TIMES = np.arange(0.0, 120.0, 2.0)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return Scene(3, 3, times=TIMES).objects(2)


@pytest.fixture(scope="module")
def block(scene) -> BlockViews:
    return block_of(tables(scene))


def test_windows_hold_every_view_once_in_order(scene, block):
    items = block.items
    assert items.n_views.sum() == tables(scene).views.num_rows == 6 * len(TIMES)
    assert np.lexsort((items.tracklet, items.window)).tolist() == list(range(len(items.window)))
    assert len(np.unique(np.column_stack([items.window, items.tracklet]), axis=0)) == 24
    for ends in (items.first_ns, items.last_ns):
        assert ((ends - START_NS) // (30 * SECOND_NS) == items.window).all()
    assert np.unique(items.window).tolist() == [0, 1, 2, 3]
    assert len(block.instants) == 4


def test_items_have_the_ends_the_sensors_and_the_number_of_their_views(scene):
    scene = Scene(3, 3, times=TIMES).objects(2)
    scene.seen[1] = (TIMES > 35) & (TIMES < 71)  # 36 to 70 s: two windows, a part of the third
    items = block_of(tables(scene)).items
    rows = np.flatnonzero(items.tracklet == 1)
    assert items.window[rows].tolist() == [1, 2]
    assert ((items.first_ns[rows] - START_NS) / 1e9).tolist() == [36.0, 60.0]
    assert ((items.last_ns[rows] - START_NS) / 1e9).tolist() == [58.0, 70.0]
    assert items.n_views[rows].tolist() == [12, 6]
    assert items.sensor[rows].tolist() == [scene.sensor[1]] * 2


def test_no_views_have_no_windows(scene):
    of = tables(scene)
    block = block_of(of._replace(views=of.views.slice(0, 0)))
    assert all(len(column) == 0 for column in block.items)
    assert block.instants == []


def test_views_outside_the_block_are_left_out(scene):
    of = tables(scene)
    time = Span(START_NS + 30 * SECOND_NS, START_NS + 60 * SECOND_NS)
    block = BlockViews(sensor_views(of), of.cameras, time, 30.0, 6.0)
    assert block.items.n_views.sum() == time.of(of.views, "epoch").num_rows == 6 * 15
    assert time.holds(block.epochs).all()
    assert time.holds(np.concatenate(block.instants)).all()
    outside = np.array([START_NS, START_NS + 40 * SECOND_NS, START_NS + 60 * SECOND_NS])
    views, _ = block.views_at(outside)
    assert set(array(views, "epoch").tolist()) == {START_NS + 40 * SECOND_NS}


def test_tracklets_are_numbered_by_their_ids_whatever_their_sensors(scene, block):
    assert block.tracklet_id.tolist() == [f"t{k:04d}" for k in range(6)]
    assert block.sensor_of_tracklet.tolist() == scene.sensor


def test_views_at_some_epochs_are_those_with_their_tracklets(scene, block):
    instants = START_NS + np.array([10, 40]) * SECOND_NS
    views, tracklet = block.views_at(instants)
    at = np.searchsorted(TIMES, (array(views, "epoch") - START_NS) / 1e9)
    assert sorted(zip(tracklet.tolist(), at.tolist(), strict=True)) == [
        (t, k) for t in range(6) for k in (5, 20)
    ]
    np.testing.assert_allclose(array(views, "ux"), np.array(scene.u)[tracklet, at, 0], atol=1e-12)


def test_views_of_some_items_are_those_of_their_windows(block):
    instants = START_NS + np.array([10, 40]) * SECOND_NS
    items = np.flatnonzero((block.items.window == 1) & (block.items.tracklet > 3))
    views, tracklet = block.views_at(instants, items)
    assert sorted(tracklet.tolist()) == [4, 5]
    assert set(array(views, "epoch").tolist()) == {instants[1]}


def test_windows_begin_at_the_same_times_in_every_block(scene):
    """So a block of ten minutes has the windows that the whole span has."""
    of = tables(scene)
    whole, part = (
        BlockViews(sensor_views(of), of.cameras, time, 30.0, 6.0)
        for time in (SPAN, Span(START_NS + 60 * SECOND_NS, SPAN.end_ns))
    )
    assert part.window_number.tolist() == whole.window_number.tolist()[2:]
    assert [i.tolist() for i in part.instants] == [i.tolist() for i in whole.instants[2:]]

"""Judge a span: objects enough to tell the errors of each sensor, as many as may be held."""

import collections

import numpy as np
import polars as pl
import pytest
from scenes.object_members import members

from epipole.schemas.bridge import empty, to_polars
from epipole.schemas.work_tables import OBJECT_MEMBERS
from epipole.tasks.solve.positions.judge_span import ENOUGH, telling_objects


def random_members(seed, n_objects=60, n_sensors=7):
    """Objects that two sensors or more see, of different lengths; sensor 6 sees only two."""
    rng = np.random.default_rng(seed)
    rows = []
    for k in range(n_objects):
        seen_by = rng.choice(n_sensors - 1, size=rng.integers(2, n_sensors), replace=False)
        own = [*sorted(seen_by.tolist()), *([n_sensors - 1] if k in (17, 41) else [])]
        rows += [(k, s, f"{s}-{k}", f"{s}-{k}", 0, 60, int(rng.integers(20, 400))) for s in own]
    return members(*rows)


def total(rows) -> int:
    return int(to_polars(rows)["n_views"].sum())


def test_all_objects_tell_where_all_may_be_held():
    rows = random_members(1)
    assert telling_objects(rows, total(rows)).equals(rows)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("share", [0.9, 0.5, 0.2])
def test_some_objects_are_whole_and_no_more_than_may_be_held(seed, share):
    rows = random_members(seed)
    most = int(share * total(rows))
    chosen = telling_objects(rows, most)
    assert 0 < total(chosen) <= most
    objects = set(chosen["object"].to_pylist())
    assert chosen.equals(rows.filter(np.isin(rows["object"].to_numpy(), list(objects))))


@pytest.mark.parametrize("seed", range(4))
def test_each_sensor_gets_some_and_one_that_sees_few_gets_all_it_sees(seed):
    rows = random_members(seed)
    chosen = to_polars(telling_objects(rows, total(rows) // 2))
    seen = collections.Counter(chosen.select("sensor", "object").unique()["sensor"].to_list())
    assert seen.keys() == set(range(7))
    assert seen[6] == 2
    assert all(seen[sensor] >= ENOUGH for sensor in range(6))


def test_a_sensor_s_longest_objects_are_the_first():
    rows = members(*[
        (k, s, f"{s}-{k}", f"{s}-{k}", 0, 60, 100 + 10 * k) for k in range(20) for s in (0, 1)
    ])  # fmt: skip
    chosen = telling_objects(rows, total(rows) - 1)
    assert sorted(set(chosen["object"].to_pylist())) == list(range(20 - ENOUGH, 20))


def test_one_object_is_judged_however_long_it_is():
    rows = members((0, 0, "a", "a", 0, 60, 500), (0, 1, "b", "b", 0, 60, 500))
    assert telling_objects(rows, 10).equals(rows)


def test_the_order_of_the_rows_does_not_matter():
    rows = random_members(2)
    mixed = rows.take(np.random.default_rng(0).permutation(rows.num_rows))
    one, other = (telling_objects(r, total(rows) // 4) for r in (rows, mixed))
    key = ["object", "sensor"]
    assert to_polars(one).sort(key).equals(to_polars(other).sort(key))
    assert pl.Series(one["object"].to_pylist()).n_unique() < 60


def test_no_objects_stay_none():
    assert telling_objects(empty(OBJECT_MEMBERS), 100).num_rows == 0

"""Kept lines: fewer of them still show every sensor at many epochs and every object."""

import itertools

import numpy as np
import polars as pl
import pytest
from scenes.associations import START_NS, filled

from epipole.schemas.bridge import to_polars
from epipole.schemas.tables import POSITIONS
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.common.grouping import group_offsets
from epipole.tasks.solve.sample_sight_lines import (
    LineSampling,
    moving_objects,
    object_views,
    sample_sight_lines,
)
from epipole.tasks.solve.view_groups import ViewGroups, unpack_views

EVERY_NS = 10_000_000_000
N_EPOCHS, N_OBJECTS, N_SENSORS = 320, 12, 10


@pytest.fixture(scope="module")
def kept_lines():
    """A function that returns the lines that are kept of all sensors, objects and epochs."""
    epochs = START_NS + np.arange(N_EPOCHS) * EVERY_NS // 2
    seen = list(itertools.product(epochs.tolist(), range(N_OBJECTS), range(N_SENSORS)))
    epoch, number, sensor = (list(column) for column in zip(*seen, strict=True))
    shared = {"epoch": epoch, "sensor_id": [f"sat{s}" for s in sensor]}
    views = filled(VIEWS, len(seen), shared | {
        **{f"sensor_v{a}_km_s": np.ones(len(seen)) for a in "xyz"}, "ux": np.ones(len(seen)),
    })  # fmt: skip
    unpacked = unpack_views(views, np.array(number))
    offsets = group_offsets(unpacked.epoch_ns, unpacked.object_number)
    ids = [f"20190401-{k + 1:05d}" for k in unpacked.object_number[offsets[:-1]]]
    groups = ViewGroups(**dict.fromkeys(ViewGroups._fields))._replace(
        views=unpacked, offsets=offsets, epoch_ns=unpacked.epoch_ns[offsets[:-1]],
        object_id=np.array(ids, object),
    )  # fmt: skip
    each = list(itertools.product(epochs.tolist(), range(N_OBJECTS)))
    positions = filled(POSITIONS, len(each), {
        "epoch": [t for t, _ in each], "time": [t for t, _ in each],
        "object_id": [f"20190401-{k + 1:05d}" for _, k in each],
        "x_km": np.full(len(each), 42000.0),
    })  # fmt: skip

    def kept(one_in: int) -> pl.DataFrame:
        choice = LineSampling(EVERY_NS, one_in)
        objects = moving_objects(positions, choice.every_ns)
        assert object_views(unpacked, objects).num_rows == len(seen) // 2  # whatever is kept
        return to_polars(sample_sight_lines(groups, objects, choice))

    return kept


def test_lines_are_kept_at_multiples_of_a_time(kept_lines):
    lines = kept_lines(1)
    assert len(lines) == N_EPOCHS // 2 * N_OBJECTS * N_SENSORS
    assert (lines["epoch"].cast(pl.Int64) % EVERY_NS == 0).all()


def test_of_fewer_lines_each_sensor_has_many_epochs_and_each_object_two_sensors(kept_lines):
    lines = kept_lines(4)
    everything = N_EPOCHS // 2 * N_OBJECTS * N_SENSORS
    assert 0.8 * everything / 4 < len(lines) < 1.2 * everything / 4
    per_sensor = lines.group_by("sensor_id").agg(pl.col("epoch").n_unique())
    assert len(per_sensor) == N_SENSORS
    assert per_sensor["epoch"].min() >= N_EPOCHS // 2 - 2
    assert lines.group_by("epoch", "object_id").len()["len"].min() >= 2


@pytest.mark.parametrize("one_in", [2, 4, 7])
def test_of_an_object_at_an_epoch_the_lines_of_all_sensors_are_kept_or_none(kept_lines, one_in):
    """Each two sensors are compared, whatever their names."""
    lines = kept_lines(one_in)
    assert set(lines.group_by("epoch", "object_id").len()["len"]) == {N_SENSORS}
    assert lines["object_id"].n_unique() == N_OBJECTS


@pytest.mark.parametrize(("one_in", "stride"), [(2, 2), (2, 6), (4, 4), (4, 8), (6, 3)])
def test_every_object_has_lines_at_some_of_the_epochs_that_a_night_is_judged_at(
    kept_lines, one_in, stride
):
    """A long night is judged at each of some epochs that lie evenly among those with lines."""
    lines = kept_lines(one_in)
    epochs = lines["epoch"].unique().sort()[::stride]
    judged = lines.filter(pl.col("epoch").is_in(epochs.implode()))
    assert judged["object_id"].n_unique() == N_OBJECTS

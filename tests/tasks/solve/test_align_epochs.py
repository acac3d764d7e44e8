"""Align epochs: which sensor sets the interval of the grid, and which frames serve an epoch."""

import numpy as np
from scenes.associations import filled

from epipole.schemas.bridge import array, concat
from epipole.schemas.settings import AlignmentSettings
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.solve.align_epochs import align_epochs, frame_times, night_grid

T0 = 1_554_091_200_000_000_000
SECOND_NS = 1_000_000_000
SETTINGS = AlignmentSettings()


def solutions(sensor, n, every_s=1.0, solved=None):
    """SOLUTIONS of a sensor with n frames; of all or some of them the attitude is known."""
    source = np.full(n, "stars", object)
    if solved is not None:
        source[np.setdiff1d(np.arange(n), solved)] = "none"
    return filled(SOLUTIONS, n, {
        "time": T0 + np.round(np.arange(n) * every_s * SECOND_NS).astype(np.int64),
        "sensor_id": [sensor] * n, "frame_number": np.arange(n), "attitude_source": source,
        **{f"{axis}_km": np.full(n, 7000.0) for axis in "xyz"},
    })  # fmt: skip


def test_the_slowest_sensor_sets_the_interval():
    fast, slow = solutions("a", 600), solutions("b", 100, every_s=6.0)
    assert night_grid([frame_times([fast]), frame_times([slow])], SETTINGS).interval_ns == 6e9
    epochs = align_epochs(concat(SOLUTIONS, [fast, slow]), SETTINGS)
    assert (np.diff(np.unique(array(epochs, "epoch"))) == 6e9).all()


def test_a_sensor_of_which_few_frames_have_an_attitude_is_not_slow():
    """It is blinded for most of the time. The epochs of the others are not fewer for that."""
    whole, blind = solutions("a", 600), solutions("b", 600, solved=[3, 170, 420])
    parts = [blind.slice(0, 200), blind.slice(200)]
    assert frame_times(parts).usable_ns.tolist() == [T0 + k * SECOND_NS for k in (3, 170, 420)]
    grid = night_grid([frame_times([whole]), frame_times(parts)], SETTINGS)
    assert grid.interval_ns == SECOND_NS
    epochs = align_epochs(concat(SOLUTIONS, [blind, whole]), SETTINGS)
    assert (array(epochs, "sensor_id") == "a").sum() == 600


def test_sensors_without_a_usable_frame_do_not_count():
    whole, none = solutions("a", 600), solutions("b", 20, every_s=60.0, solved=[])
    grid = night_grid([frame_times([whole]), frame_times([none])], SETTINGS)
    assert grid.interval_ns == SECOND_NS
    assert night_grid([], SETTINGS).interval_ns == SECOND_NS
    assert align_epochs(none, SETTINGS).num_rows == 0


def test_single_usable_frames_have_epochs_of_their_own():
    one, other = solutions("a", 1), solutions("b", 30, solved=[0])
    assert night_grid([frame_times([one]), frame_times([other])], SETTINGS).epochs_ns == (T0,)

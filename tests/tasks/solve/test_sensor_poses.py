"""Sensor poses: where the sensors are and look, where a frame is near; else unknown."""

import numpy as np
import pyarrow as pa
from scenes.associations import START_NS, WIDTH, sensor_views, tables
from scenes.tracklet_scenes import FIELD, Scene

from epipole.schemas.settings import AlignmentSettings, Settings
from epipole.tasks.common.sightings import cameras_of
from epipole.tasks.solve.association_input import SensorPoses

SECOND_NS = 1_000_000_000
TIMES = np.arange(0.0, 120.0, 2.0)


def poses_at(epochs, of) -> SensorPoses:
    names = sorted(set(of.cameras["sensor_id"].to_pylist()))
    return SensorPoses(epochs, [cameras_of(of.cameras, name) for name in names])


def poses_of(of, **alignment) -> SensorPoses:
    settings = Settings(alignment=AlignmentSettings(**alignment))
    return poses_at([one.epochs for one in sensor_views(of, settings)], of)


def test_poses_are_those_of_the_frames():
    scene = Scene(3, 3, times=TIMES).objects(2)
    poses = poses_of(tables(scene))
    here = poses.at(START_NS + np.array([10, 100]) * SECOND_NS)
    at = np.searchsorted(TIMES, [10.0, 100.0])
    np.testing.assert_allclose(here.sensor_km, scene.r[:, at], atol=1e-9)
    true = scene.samples().R_sensor_from_icrs[:, at]
    np.testing.assert_allclose(here.R_sensor_from_icrs, true, atol=1e-12)
    assert (here.sensor_km_s == 0.0).all()
    fields = poses.fields_at(START_NS + np.array([10, 100]) * SECOND_NS)
    np.testing.assert_allclose(fields.half_field, np.full((3, 2), np.tan(FIELD / 2)))
    np.testing.assert_allclose(fields.focal_px, np.full(3, WIDTH / 2 / np.tan(FIELD / 2)))


def test_fields_are_those_of_the_cameras_at_the_time():
    of = tables(Scene(3, 3, times=TIMES).objects(2))
    # From 60 s on the second sensor reads out half of its rows, with half the focal length.
    again = of.cameras.slice(1, 1).to_pylist()[0]
    again |= {"height": WIDTH // 2, "fx_px": again["fx_px"] / 2, "fy_px": again["fy_px"] / 2}
    again["time"] = None
    time = pa.array([START_NS + 60 * SECOND_NS]).cast(of.cameras.schema.field("time").type)
    row = pa.Table.from_pylist([again], schema=of.cameras.schema)
    row = row.set_column(row.schema.get_field_index("time"), row.schema.field("time"), time)
    of = of._replace(cameras=pa.concat_tables([of.cameras, row]))
    epochs = [one.epochs for one in sensor_views(of)]
    late = np.array(epochs[1]["epoch"].cast(pa.int64())) >= START_NS + 60 * SECOND_NS
    at = epochs[1].schema.get_field_index("camera")
    epochs[1] = epochs[1].set_column(at, "camera", pa.array(late.astype(np.int64)))
    poses, half, focal = poses_at(epochs, of), np.tan(FIELD / 2), WIDTH / 2 / np.tan(FIELD / 2)
    for at_s, first in (([0.0, 10.0, 20.0], True), ([70.0, 80.0, 90.0], False), ([500.0], False)):
        fields = poses.fields_at(START_NS + (np.array(at_s) * SECOND_NS).astype(np.int64))
        of_second = [half, half] if first else [2 * half, half]
        np.testing.assert_allclose(fields.half_field, [[half, half], of_second, [half, half]])
        np.testing.assert_allclose(fields.focal_px, [focal, focal if first else focal / 2, focal])


def test_a_sensor_whose_frame_is_far_from_an_instant_has_no_pose_there():
    of = tables(Scene(3, 3, times=TIMES).objects(2))
    late = (of.solutions["frame_number"].to_numpy() >= 30) & (
        np.array(of.solutions["sensor_id"]) == "sat1"
    )  # its last frame is at 58 s
    poses = poses_of(of._replace(solutions=of.solutions.filter(~late)), max_gap_s=100.0)
    here = poses.at(START_NS + np.array([10, 58, 60, 62, 100]) * SECOND_NS)
    known = np.isfinite(here.R_sensor_from_icrs).all(axis=(2, 3))
    assert known.tolist() == [[True] * 5, [True, True, False, False, False], [True] * 5]
    assert (np.isfinite(here.sensor_km).all(axis=2) == known).all()


def test_a_sensor_without_epochs_has_no_pose():
    of = tables(Scene(3, 3, times=TIMES).objects(2))
    epochs = [one.epochs for one in sensor_views(of)]
    epochs[1] = epochs[1].slice(0, 0)
    here = poses_at(epochs, of).at(START_NS + np.array([10, 100]) * SECOND_NS)
    known = np.isfinite(here.sensor_km).all(axis=(1, 2))
    assert known.tolist() == [True, False, True]

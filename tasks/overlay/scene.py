"""Sensors and objects in space, as messages that a viewer draws in three dimensions.

The frame is GCRF, lengths are metres. What is small beside the Earth is drawn large enough to be
seen: an object is a pale sphere of `SEEN_KM` by which it is found, and inside or around it a solid
error ellipsoid of three sigma.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import polars as pl
from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform
from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud
from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

from epipole.schemas.columns import POSITION
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM
from epipole.tasks.algorithms.geometry.directions import quaternion_from_matrix
from epipole.tasks.overlay.annotations import BLUE, ORANGE, _colour, _time

ROOT_FRAME = "GCRF"
KM = 1000.0  # m
SEEN_KM = 100.0  # diameter
SIGMAS = 3.0
GREY = (0.6, 0.6, 0.6)


def transform(time_ns: int, sensor_id: str, row: dict[str, Any]) -> bytes:
    """Return where a sensor is and how it is turned, from a row of FRAMES with an attitude."""
    message: Any = FrameTransform(parent_frame_id=ROOT_FRAME, child_frame_id=sensor_id)
    _time(message.timestamp, time_ns)
    _vector(message.translation, [row[name] for name in POSITION])
    # The quaternion of FRAMES turns GCRF into the sensor; a transform is the way back.
    turn = message.rotation
    turn.x, turn.y, turn.z, turn.w = -row["qx"], -row["qy"], -row["qz"], row["qw"]
    data: bytes = message.SerializeToString(deterministic=True)
    return data


def earth(time_ns: int) -> bytes:
    """Return the Earth as a sphere that stays."""
    message: Any = SceneUpdate()
    ball = _entity(message, time_ns, "Earth").spheres.add()
    _size(ball, [2 * EARTH_RADIUS_KM] * 3)
    _colour(ball.color, GREY, 0.4)
    data: bytes = message.SerializeToString(deterministic=True)
    return data


def objects(
    time_ns: int,
    positions: pl.DataFrame,
    seen_from: Mapping[str, Sequence[tuple[float, ...]]],
    lifetime_ns: int,
) -> bytes:
    """Return the objects of an epoch, and the lines of sight that see them.

    Parameters
    ----------
    positions
        POSITIONS of the epoch.
    seen_from
        The positions [km] of the sensors that see each object.
    lifetime_ns
        How long they are shown, if no later message has them.
    """
    message: Any = SceneUpdate()
    for row in positions.iter_rows(named=True):
        entity = _entity(message, time_ns, row["object_id"])
        entity.lifetime.seconds, entity.lifetime.nanos = divmod(lifetime_ns, 1_000_000_000)
        position = [row[name] for name in POSITION]
        _sphere(entity, position, [SEEN_KM] * 3, ORANGE, 0.25)
        _ellipsoid(entity, row)
        label = entity.texts.add(text=row["object_id"], font_size=14.0, billboard=True)
        label.scale_invariant = True
        _vector(label.pose.position, position)
        label.pose.orientation.w = 1.0
        _colour(label.color, ORANGE)
        sight = entity.lines.add(type=2, thickness=1.0, scale_invariant=True)  # pairs of points
        sight.pose.orientation.w = 1.0
        for sensor_km in seen_from.get(row["object_id"], ()):
            _vector(sight.points.add(), sensor_km)
            _vector(sight.points.add(), position)
        _colour(sight.color, BLUE, 0.6)
    data: bytes = message.SerializeToString(deterministic=True)
    return data


def points(time_ns: int, positions: pl.DataFrame) -> bytes:
    """Return the objects of an epoch as points alone, for viewers that know no scenes."""
    message: Any = PointCloud(frame_id=ROOT_FRAME, point_stride=12)
    _time(message.timestamp, time_ns)
    message.pose.orientation.w = 1.0
    for number, name in enumerate("xyz"):
        message.fields.add(name=name, offset=4 * number, type=PackedElementField.FLOAT32)
    message.data = (positions.select(POSITION).to_numpy() * KM).astype("<f4").tobytes()
    data: bytes = message.SerializeToString(deterministic=True)
    return data


def _entity(message: Any, time_ns: int, name: str) -> Any:
    entity = message.entities.add(frame_id=ROOT_FRAME, id=name)
    _time(entity.timestamp, time_ns)
    return entity


def _ellipsoid(entity: Any, row: dict[str, Any]) -> None:
    upper = [row[f"cov_{axes}"] for axes in ("xx", "xy", "xz", "yy", "yz", "zz")]
    xx, xy, xz, yy, yz, zz = upper
    values, vectors = np.linalg.eigh(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]))
    if np.linalg.det(vectors) < 0:  # a reflection: a rotation has determinant 1
        vectors[:, 0] = -vectors[:, 0]
    axes_km = 2 * SIGMAS * np.sqrt(np.maximum(values, 0))
    ball = _sphere(entity, [row[name] for name in POSITION], axes_km, ORANGE, 0.9)
    turn = ball.pose.orientation
    turn.x, turn.y, turn.z, turn.w = quaternion_from_matrix(vectors).tolist()


def _sphere(
    entity: Any, position_km: Any, axes_km: Any, colour: tuple[float, ...], opacity: float
) -> Any:
    ball = entity.spheres.add()
    _vector(ball.pose.position, position_km)
    _size(ball, axes_km)
    _colour(ball.color, colour, opacity)
    return ball


def _size(ball: Any, axes_km: npt.ArrayLike) -> None:
    ball.pose.orientation.w = 1.0
    _vector(ball.size, axes_km)


def _vector(vector: Any, km: Any) -> None:
    vector.x, vector.y, vector.z = (float(value) * KM for value in km)

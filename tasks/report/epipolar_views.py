"""Epipolar lines of one epoch: one sensor's lines of sight as lines in another's image."""

from typing import NamedTuple

import numpy as np
import polars as pl

from epipole.io.datasets.night_tables import NightReader
from epipole.schemas.arrays import Array
from epipole.schemas.columns import POSITION, VELOCITY
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.camera import Camera, distort, project, unproject
from epipole.tasks.algorithms.geometry.directions import (
    aberrate,
    interpolate_quaternions,
    matrix_from_quaternion,
    unit_from_radec,
)
from epipole.tasks.algorithms.geometry.epipolar import epipolar_angle

MAX_LINES = 12
MAX_PAIRS = 12  # of sensors that are tried
MIN_BASELINE_KM = 1.0  # from sensor to sensor: of nearer ones the lines are noise
STEPS = 2000  # along a line
POINTS = 12  # of a line that is drawn
BEYOND = 1.05  # of the field: farther out a fitted distortion may fold the image
MAX_OTHERS = 300
MIN_SEEN = 10  # detections that show the camera in use
MOTION_NS = 5_000_000_000  # positions so near to the epoch show how an object moves
AROUND_NS = 60_000_000_000  # frames so near to an epoch give the attitude at it
QUATERNION = ["qx", "qy", "qz", "qw"]
SEEN = ["x_px", "y_px", "ra_deg", "dec_deg"]
OPTICS = ["fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3", "k4",
          "fisheye"]  # fmt: skip


class EpipolarLine(NamedTuple):
    """An object: its line (n, 2) in the image, where it was seen (2,), and how far apart [px]."""

    object_id: str
    line_px: Array
    seen_px: Array
    distance_px: float


class EpipolarViews(NamedTuple):
    """The image of one sensor at an epoch, with lines of the other's lines of sight.

    `others_px` (m, 2) are the other detections of the frame that is nearest to the epoch.
    """

    epoch_ns: int
    from_sensor: str
    in_sensor: str
    size_px: Array
    lines: list[EpipolarLine]
    others_px: Array


class _Pose(NamedTuple):
    """A sensor at the epoch, GCRF."""

    camera: Camera
    R_sensor_from_icrs: Array
    r_km: Array
    v_km_s: Array


def read_epipolar_views(
    night: NightReader, epoch_ns: int, calibrations: pl.DataFrame, sizes_px: dict[str, Array]
) -> EpipolarViews | None:
    """Return an epoch's views of the two sensors that share the most objects.

    None: it has no object that two sensors with calibrations saw, or these are on one satellite or
    side by side.
    """
    cameras = _cameras(calibrations, sizes_px)
    columns = ["epoch", "object_id", "sensor_id", "frame_number", "x_px", "y_px", "epipolar_px",
               "used"]  # fmt: skip
    views = night.read("associations", columns, (epoch_ns, epoch_ns + 1))
    views = views.filter(pl.col("used") & pl.col("sensor_id").is_in(list(cameras)))
    for first, second in _pairs(views):
        shared = first.join(second, on="object_id", suffix="_in").sort("object_id")
        names = shared["sensor_id"][0], shared["sensor_id_in"][0]
        poses = [_pose(night, name, cameras[name], epoch_ns) for name in names]
        if poses[0] is None or poses[1] is None:
            continue
        if np.linalg.norm(poses[0].r_km - poses[1].r_km) < MIN_BASELINE_KM:
            continue
        lines = _lines(night, shared.head(MAX_LINES), (poses[0], poses[1]), epoch_ns)
        return EpipolarViews(
            epoch_ns, *names, np.array(cameras[names[1]][:2], float), lines,
            _others(night, names[1], int(shared["frame_number_in"][0]), epoch_ns),
        )  # fmt: skip
    return None


def _cameras(calibrations: pl.DataFrame, sizes_px: dict[str, Array]) -> dict[str, Camera]:
    found = {}
    for row in calibrations.select("sensor_id", *OPTICS).iter_rows():
        if row[0] in sizes_px:
            width, height = (int(n) for n in sizes_px[row[0]])
            found[row[0]] = Camera(width, height, *row[1:])
    return found


def best_epoch(night: NightReader) -> int | None:
    """Return the epoch with the most used views; the first of several."""
    best: tuple[int, int] | None = None
    carried = pl.DataFrame(schema={"epoch": pl.Int64, "views": pl.UInt32})
    for rows in night.pieces("associations", ["epoch", "used"]):
        used = rows.filter("used").select(pl.col("epoch").dt.epoch("ns"))
        counts = used.group_by("epoch", maintain_order=True).agg(views=pl.len())
        both = pl.concat([carried, counts]).group_by("epoch", maintain_order=True)
        summed = both.agg(pl.col("views").sum())
        for epoch, views in summed.sort("views", "epoch", descending=[True, False]).head(1).rows():
            if best is None or views > best[0]:
                best = views, epoch
        carried = summed.tail(1)  # its other views may be in the next piece
    return best[1] if best else None


def _pairs(views: pl.DataFrame) -> list[tuple[pl.DataFrame, pl.DataFrame]]:
    """Return the views of every two sensors, those that share the most objects first."""
    both = views.select("object_id", "sensor_id").join(
        views.select("object_id", "sensor_id"), on="object_id", suffix="_in"
    )
    both = both.filter(pl.col("sensor_id") < pl.col("sensor_id_in"))
    counts = both.group_by("sensor_id", "sensor_id_in").len()
    counts = counts.sort("len", "sensor_id", "sensor_id_in", descending=[True, False, False])
    pairs = []
    for names in counts.select("sensor_id", "sensor_id_in").head(MAX_PAIRS).iter_rows():
        first, second = (views.filter(pl.col("sensor_id") == name) for name in names)
        # The nearer sensor has the smaller error in km, so its lines are the finer ones.
        if np.mean(second["epipolar_px"].to_numpy()) > np.mean(first["epipolar_px"].to_numpy()):
            first, second = second, first
        pairs.append((first, second))
    return pairs


def _pose(night: NightReader, name: str, camera: Camera, epoch_ns: int) -> _Pose | None:
    """Return where the sensor was and how it stood at the epoch; None: unknown from its frames."""
    rows = _near(
        night, "frames", ["frame_number", *QUATERNION, *POSITION, *VELOCITY], name, epoch_ns
    )
    rows = rows.drop_nulls([*QUATERNION, *POSITION])
    if not len(rows):
        return None
    since_s = (rows["time"].dt.epoch("ns").to_numpy() - epoch_ns) / 1e9
    q = interpolate_quaternions(since_s, rows.select(QUATERNION).to_numpy(), np.zeros(1))
    at = int(np.argmin(np.abs(since_s)))
    v_km_s = np.nan_to_num(rows.select(VELOCITY).to_numpy()[at].astype(float))
    r_km = rows.select(POSITION).to_numpy()[at] - since_s[at] * v_km_s
    seen = _near(night, "detections", ["frame_number", *SEEN], name, epoch_ns).drop_nulls()
    seen = seen.join(rows.select("frame_number", *QUATERNION), on="frame_number")
    return _Pose(_camera_in_use(camera, seen), matrix_from_quaternion(q)[0], r_km, v_km_s)


def _camera_in_use(camera: Camera, seen: pl.DataFrame) -> Camera:
    """Return the camera that the attitudes go with: it is not always the fitted one.

    The detections show it: each has a pixel position and a direction.
    """
    if len(seen) < MIN_SEEN:
        return camera
    R = matrix_from_quaternion(seen.select(QUATERNION).to_numpy())
    ra, dec = np.radians(seen.select("ra_deg", "dec_deg").to_numpy()).T
    u = np.einsum("nij,nj->ni", R, unit_from_radec(ra, dec))
    x, y = distort(camera, u[:, 0] / u[:, 2], u[:, 1] / u[:, 2])
    fx, cx = np.polyfit(x, seen["x_px"].to_numpy(), 1)
    fy, cy = np.polyfit(y, seen["y_px"].to_numpy(), 1)
    return camera._replace(fx_px=float(fx), fy_px=float(fy), cx_px=float(cx), cy_px=float(cy))


def _near(
    night: NightReader, table: str, columns: list[str], name: str, epoch_ns: int
) -> pl.DataFrame:
    """Return the rows of a sensor that are near to an epoch."""
    columns = ["time", "sensor_id", *columns]
    between = epoch_ns - AROUND_NS, epoch_ns + AROUND_NS
    is_sensor = pl.col("sensor_id") == name
    pieces = [rows.filter(is_sensor) for rows in night.pieces(table, columns, between)]
    return pl.concat([night.empty(table, columns), *pieces])


def _lines(
    night: NightReader, shared: pl.DataFrame, poses: tuple[_Pose, _Pose], epoch_ns: int
) -> list[EpipolarLine]:
    first, second = poses
    seen = shared.select("x_px", "y_px").to_numpy()
    seen_in = shared.select("x_px_in", "y_px_in").to_numpy()
    u_1, u_2 = (_geometric(pose, px) for pose, px in ((first, seen), (second, seen_in)))
    r_1, r_2 = _seen_together(night, shared["object_id"].to_list(), poses, epoch_ns)
    pixel_rad = second.camera.pixel_rad
    distance_px = np.abs(epipolar_angle(r_1, u_1, r_2, u_2)) / pixel_rad
    lines = []
    for k, name in enumerate(shared["object_id"]):
        u = aberrate(_arc(r_1[k] - r_2[k], u_1[k]), second.v_km_s)
        u = u @ second.R_sensor_from_icrs.T
        u = u[u[:, 2] > np.cos(BEYOND * second.camera.half_diagonal_rad)]
        line = np.stack(project(second.camera, u), axis=1)
        lines.append(EpipolarLine(str(name), _in_image(line, second.camera), seen_in[k],
                                  float(distance_px[k])))  # fmt: skip
    return lines


def _seen_together(
    night: NightReader, names: list[str], poses: tuple[_Pose, _Pose], epoch_ns: int
) -> list[Array]:
    """Return (n, 3) positions of each sensor, moved as if both saw an object at one position.

    The light to the farther sensor left earlier, when a low object was elsewhere by some pixels.
    """
    columns = ["epoch", "time", "object_id", *POSITION]
    between = epoch_ns - MOTION_NS, epoch_ns + MOTION_NS
    pieces = night.pieces("positions", columns, between)
    rows = pl.concat([night.empty("positions", columns), *pieces])
    moved = [np.tile(pose.r_km, (len(names), 1)) for pose in poses]
    for k, name in enumerate(names):
        track = rows.filter(pl.col("object_id") == name)
        time_s = (track["time"].dt.epoch("ns").to_numpy() - epoch_ns) / 1e9
        if len(track) < 2:
            continue
        x_km = track.select(POSITION).to_numpy()
        v_km_s = (x_km[-1] - x_km[0]) / (time_s[-1] - time_s[0])
        at = int(np.argmin(np.abs(track["epoch"].dt.epoch("ns").to_numpy() - epoch_ns)))
        for pose, r_km in zip(poses, moved, strict=True):
            light_s = np.linalg.norm(x_km[at] - pose.r_km) / SPEED_OF_LIGHT_KM_S
            r_km[k] += v_km_s * (light_s + time_s[at])
    return moved


def _geometric(pose: _Pose, px: Array) -> Array:
    """Return the directions (ICRS) of pixel positions, aberration removed."""
    apparent = unproject(pose.camera, px[:, 0], px[:, 1]) @ pose.R_sensor_from_icrs
    return aberrate(apparent, -pose.v_km_s)


def _arc(baseline_km: Array, u: Array) -> Array:
    """Return directions along the line of sight: from the other sensor (range 0) to far away."""
    start = baseline_km / np.linalg.norm(baseline_km)
    angle = np.arccos(np.clip(start @ u, -1.0, 1.0))
    t = np.linspace(0.0, 1.0, STEPS)[:, None]
    mixed = np.sin((1 - t) * angle) * start + np.sin(t * angle) * u
    length = np.linalg.norm(mixed, axis=1, keepdims=True)
    return mixed / np.where(length > 0, length, 1.0)


def _in_image(line: Array, camera: Camera) -> Array:
    """Return the part of a line in the image, as a few points."""
    inside = (line > 0) & (line < [camera.width, camera.height])
    kept = np.flatnonzero(inside.all(axis=1))
    if not len(kept):
        return np.empty((0, 2))
    part = line[max(kept[0] - 1, 0) : kept[-1] + 2]
    return part[np.unique(np.linspace(0, len(part) - 1, POINTS).astype(int))]


def _others(night: NightReader, name: str, frame: int, epoch_ns: int) -> Array:
    rows = _near(night, "detections", ["frame_number", "x_px", "y_px"], name, epoch_ns)
    in_frame = rows.filter(pl.col("frame_number") == frame)
    return in_frame.select("x_px", "y_px").head(MAX_OTHERS).to_numpy()

"""The input of association: the views of all sensors in a block, sampled at a few instants.

- `even_instants` and `with_ends` choose the instants of a window at which its tracklets are
  compared.
- `SensorPoses` has the attitudes and positions of the sensors.
- `BlockViews` keeps the epoch and tracklet of all views. The other columns are read for the chosen
  instants only.
- `SampledViews` turns the views at these instants into the arrays of the methods.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import pyarrow as pa

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.schemas.bridge import array, stack, stack_covariance
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.spans import Span
from epipole.schemas.work_tables import VIEWS
from epipole.tasks.algorithms.association.samples import Samples, repeated_samples
from epipole.tasks.algorithms.association.window_groups import Items
from epipole.tasks.algorithms.geometry.directions import matrix_from_quaternion
from epipole.tasks.algorithms.tracking.blends import BLEND_PX
from epipole.tasks.common.grouping import group_offsets
from epipole.tasks.common.sightings import camera_of, cameras_of

# Instants.

MAX_SAMPLES = 12  # even instants in a window
END_STEP_NS = 1_000_000_000  # minimum time between instants at which tracklets enter or leave
MAX_ENDS = 30  # limit of these in a window: in a long one they are farther apart
MAX_BLEND = 4.0  # variance that blends may add to a clear view, over that of its noise or bias


def clear_views(views: pa.Table) -> Flags:
    """Return which VIEWS are clear: blends add little to their variance.

    The others may show the object or its neighbour. Groups are found without them; they belong to
    the group of their tracklet. A tracklet that is blended throughout is judged by its best views.
    """
    blend = 2 * array(views, "blend_rad2")
    noise = array(views, "cov_noise_11_rad2") + array(views, "cov_noise_22_rad2") - blend
    shared = array(views, "cov_bias_11_rad2") + array(views, "cov_bias_22_rad2")
    return np.asarray(blend <= MAX_BLEND * np.maximum(noise, shared))


def even_instants(epochs: Indices, window_s: float) -> Indices:
    """Return a few of the epochs, evenly spaced and far enough apart to be independent.

    Parameters
    ----------
    epochs
        Distinct, in order [ns].
    window_s
        A view is fitted to detections within this time of its epoch: views at two epochs within
        twice this time share detections.
    """
    if not len(epochs):
        return epochs
    step = 2 * window_s * 1e9
    n = min(int(max((epochs[-1] - epochs[0]) // step, 1)), MAX_SAMPLES)
    edges = np.linspace(epochs[0], epochs[-1], n + 1)
    middle = (edges[1:] + edges[:-1]) / 2
    return np.unique(epochs[np.argmin(np.abs(epochs[:, None] - middle), axis=0)])


def with_ends(even: Indices, epochs: Indices, first: Indices, last: Indices) -> Indices:
    """Return the instants of a window, with the ends of the tracklets that enter or leave it.

    Two tracklets that overlap for a few seconds only are compared while both have views: from the
    later first view to the earlier last view. With two instants their motions are compared too.

    Parameters
    ----------
    even
        The even instants.
    epochs
        Epochs of the window, in order. The ends are moved to the first epoch of a second, or of a
        thirtieth of a longer window.
    first, last : (n,) int
        First and last clear view of each tracklet that lacks a view at one of the even instants.
    """
    step_ns = max(END_STEP_NS, int(np.ptp(epochs)) // MAX_ENDS) if len(epochs) else END_STEP_NS
    _, begins = np.unique(epochs // step_ns, return_index=True)
    coarse = epochs[begins]
    after = np.searchsorted(coarse, first)
    before = np.searchsorted(coarse, last, side="right") - 1
    short = after > before
    middle = epochs[np.searchsorted(epochs, (first[short] + last[short]) // 2)]
    ends = np.concatenate([coarse[after[~short]], coarse[before[~short]], middle])
    return np.union1d(even, ends)


# Sensor poses.


NEAR_S = 2.0  # a frame within this time of an epoch gives the sensor's pose


class Poses(NamedTuple):
    """Poses of s sensors at k instants: attitudes (s, k, 3, 3), positions and velocities
    (s, k, 3), GCRF; NaN where no frame is near."""

    R_sensor_from_icrs: Array
    sensor_km: Array
    sensor_km_s: Array


class Fields(NamedTuple):
    """Fields of s sensors: tangents of half the width and height, (s, 2), and focal lengths [px],
    (s,)."""

    half_field: Array
    focal_px: Array


class SensorPoses:
    """The poses of sensors at their epochs, and their fields.

    Parameters
    ----------
    epochs
        SENSOR_EPOCHS of each sensor, in order of time.
    cameras
        CAMERAS of each sensor.
    """

    def __init__(self, epochs: Sequence[pa.Table], cameras: Sequence[pa.Table]) -> None:
        self._frames = [_near_frames(rows) for rows in epochs]
        self._epoch_ns = [array(rows, "epoch") for rows in epochs]
        self._camera = [array(rows, "camera") for rows in epochs]
        self._fields = [_fields_of(of_sensor) for of_sensor in cameras]

    def fields_at(self, instants: Indices) -> Fields:
        """Return the fields of a window: by the cameras at the middle one of its instants.

        A sensor without an epoch there has the camera of the epoch before, or of its first one.
        """
        middle = instants[len(instants) // 2] if len(instants) else 0
        rows = []
        for epoch_ns, camera in zip(self._epoch_ns, self._camera, strict=True):
            at = max(int(np.searchsorted(epoch_ns, middle, side="right")) - 1, 0)
            rows.append(int(camera[at]) if len(camera) else 0)
        chosen = [fields[row] for fields, row in zip(self._fields, rows, strict=True)]
        half_width, half_height, focal_px = np.reshape(np.array(chosen, float), (-1, 3)).T
        return Fields(np.column_stack([half_width, half_height]), focal_px)

    def at(self, instants: Indices) -> Poses:
        """Return the poses at some epochs."""
        n, k = len(self._frames), len(instants)
        q, r_km = np.full((n, k, 4), np.nan), np.full((n, k, 3), np.nan)
        velocity = np.full((n, k, 3), np.nan)
        for s, frames in enumerate(self._frames):
            if not len(frames.epoch_ns):
                continue
            at = np.searchsorted(frames.epoch_ns, instants)
            at = np.minimum(at, len(frames.epoch_ns) - 1)
            there = np.flatnonzero(frames.epoch_ns[at] == instants)
            q[s, there], r_km[s, there] = frames.q[at[there]], frames.r_km[at[there]]
            velocity[s, there] = frames.v_km_s[at[there]]
        return Poses(matrix_from_quaternion(q), r_km, velocity)


def _fields_of(cameras: pa.Table) -> list[tuple[float, float, float]]:
    """Return tangents of half the width and height, and the focal length [px], of each camera."""
    every = (camera_of(cameras, row) for row in range(cameras.num_rows))
    return [(*c.half_field, c.fx_px) for c in every]


class _Frames(NamedTuple):
    """Attitude, position and velocity of a sensor at its epochs."""

    epoch_ns: Indices
    q: Array
    r_km: Array
    v_km_s: Array


def _near_frames(epochs: pa.Table) -> _Frames:
    """Return the epochs with a frame near."""
    near = epochs.filter(pa.array(np.abs(array(epochs, "dt_s")) < NEAR_S))
    return _Frames(
        array(near, "epoch"),
        stack(near, "q{}", "xyzw"),
        stack(near, "{}_km"),
        stack(near, "v{}_km_s"),
    )


# Views of a block.

SAMPLED = [
    name
    for name in VIEWS.names
    if name
    in (
        "epoch",
        "ux",
        "uy",
        "uz",
        "x_km",
        "y_km",
        "z_km",
        "position_sigma_km",
        "first_fitted",
        "last_fitted",
        "magnitude",
    )
    or name.startswith(("w", "cov_"))
]


class SensorViews(NamedTuple):
    """The views of one sensor in a span: VIEWS sorted by tracklet, and the tables beside them.

    `number` and `sensor_id` name the sensor in the run, `epochs` are SENSOR_EPOCHS, `tracklets`
    are VIEWED_TRACKLETS.
    """

    number: int
    sensor_id: str
    read_views: Callable[[], pa.Table]  # they stay in their file: all of them do not fit in memory
    epochs: pa.Table
    tracklets: pa.Table


class BlockViews:
    """The views of sensors in a block of time.

    Parameters
    ----------
    sensors
        In the order of their ids.
    cameras
        CAMERAS of all of them.
    block
        Views at other epochs are left out.
    window_s, half_width_s
        Length of a window, and half the time of the detections that a view is fitted to [s].
    """

    def __init__(
        self,
        sensors: Sequence[SensorViews],
        cameras: pa.Table,
        block: Span,
        window_s: float,
        half_width_s: float,
    ) -> None:
        self.sensors, self.half_width_s = list(sensors), half_width_s
        self.sensor_id = np.array([one.sensor_id for one in sensors], str)
        self.tracklets = pa.concat_tables([one.tracklets for one in sensors]).combine_chunks()
        ids = array(self.tracklets, "tracklet_id").astype(str)
        order = np.argsort(ids, kind="stable")
        self.tracklets = self.tracklets.take(order)
        self.tracklet_id = ids[order]
        self.sensor_of_tracklet = np.repeat(
            np.arange(len(sensors)), [one.tracklets.num_rows for one in sensors]
        )[order]
        _, self.track = np.unique(
            array(self.tracklets, "track_id").astype(str), return_inverse=True
        )
        self.start_ns = array(self.tracklets, "start_time")
        self.end_ns = array(self.tracklets, "end_time")
        self.origin_ns = block.start_ns
        self.window_ns = max(round(window_s * 1e9), 1)
        self.poses = SensorPoses(
            [one.epochs for one in sensors],
            [cameras_of(cameras, one.sensor_id) for one in sensors],
        )
        self._tracklet_row = np.argsort(order, kind="stable")  # of tracklets, sensor by sensor
        self._read(block)
        self._choose_instants()

    def _read(self, block: Span) -> None:
        """Read the epochs and tracklets of the views in the block, and which views are clear."""
        self._rows, self._epoch_ns, self._tracklet, self._clear = [], [], [], []
        before, parts = 0, []
        for s, sensor in enumerate(self.sensors):
            views = sensor.read_views()
            epoch_ns = array(views, "epoch")
            rows = np.flatnonzero(block.holds(epoch_ns))
            n = sensor.tracklets.num_rows
            local = np.repeat(np.arange(n), array(sensor.tracklets, "n_views"))[rows]
            tracklet = self._tracklet_row[before : before + n][local]
            before += n
            self._rows.append(rows)
            self._epoch_ns.append(epoch_ns[rows])
            self._tracklet.append(tracklet)
            self._clear.append(clear_views(views)[rows])
            parts.append(_items(epoch_ns[rows], tracklet, s, self.window_ns))
        window, *columns = (np.concatenate(c).astype(np.int64) for c in zip(*parts, strict=True))
        order = np.lexsort((columns[0], window))
        self.window_number, window = np.unique(window[order], return_inverse=True)
        self.items = Items(window, *(values[order] for values in columns))

    def _choose_instants(self) -> None:
        """Choose the instants of each window at which its tracklets are compared."""
        epochs = np.unique(np.concatenate([np.unique(e) for e in self._epoch_ns]))
        self.epochs = epochs
        self._epoch = [np.searchsorted(epochs, e).astype(np.int32) for e in self._epoch_ns]
        cuts = np.searchsorted(
            epochs // self.window_ns, [*self.window_number, np.iinfo(np.int64).max]
        )
        even = [
            even_instants(epochs[lo:hi], self.half_width_s)
            for lo, hi in itertools.pairwise(cuts.tolist())
        ]
        ends = self._ends(even)
        self.instants = [
            with_ends(instants, epochs[lo:hi], *of_window)
            for instants, (lo, hi), of_window in zip(
                even, itertools.pairwise(cuts.tolist()), ends, strict=True
            )
        ]

    def _ends(self, even: Sequence[Indices]) -> list[tuple[Indices, Indices]]:
        """Return, for each window, the first and last clear view of each tracklet that lacks a
        clear view at one of the even instants."""
        wanted = np.isin(self.epochs, np.concatenate([*even, np.zeros(0, np.int64)]))
        n_even = np.array([len(instants) for instants in even], np.int64)
        parts = []
        for epoch_ns, epoch, tracklet, clear in zip(
            self._epoch_ns, self._epoch, self._tracklet, self._clear, strict=True
        ):
            epoch_ns, epoch, tracklet = epoch_ns[clear], epoch[clear], tracklet[clear]
            bounds = group_offsets(epoch_ns // self.window_ns, tracklet)
            if len(bounds) == 1:
                continue
            has = np.add.reduceat(wanted[epoch].astype(np.int64), bounds[:-1])
            first, last = epoch_ns[bounds[:-1]], epoch_ns[bounds[1:] - 1]
            window = np.searchsorted(self.window_number, first // self.window_ns)
            lacks = has < n_even[window]
            parts.append(np.stack([window, first, last])[:, lacks])
        window, first, last = np.concatenate([np.zeros((3, 0), np.int64), *parts], axis=1)
        rows = [np.flatnonzero(window == w) for w in range(len(even))]
        return [(first[of_window], last[of_window]) for of_window in rows]

    def views_at(self, instants: Indices, items: Indices | None = None) -> tuple[pa.Table, Indices]:
        """Return the clear views at some epochs, and the tracklet of each.

        With `items`, only the views of these items.
        """
        tables, tracklets = [VIEWS.empty_table().select(SAMPLED)], []
        wanted = np.isin(self.epochs, instants)
        key = self._item_key(items) if items is not None else None
        for s, sensor in enumerate(self.sensors):
            chosen = np.flatnonzero(wanted[self._epoch[s]] & self._clear[s])
            if key is not None:
                chosen = chosen[np.isin(self._view_key(s, chosen), key)]
            tables.append(sensor.read_views().select(SAMPLED).take(self._rows[s][chosen]))
            tracklets.append(self._tracklet[s][chosen])
        return pa.concat_tables(tables), np.concatenate(tracklets)

    def _item_key(self, items: Indices) -> Indices:
        return self.items.window[items] * len(self.tracklet_id) + self.items.tracklet[items]

    def _view_key(self, sensor: int, rows: Indices) -> Indices:
        window = np.searchsorted(self.window_number, self._epoch_ns[sensor][rows] // self.window_ns)
        return np.asarray(window * len(self.tracklet_id) + self._tracklet[sensor][rows])


def _items(
    epoch_ns: Indices, tracklet: Indices, sensor: int, window_ns: int
) -> tuple[Indices, ...]:
    """Return the columns of `Items` of one sensor, whose views are sorted by tracklet and epoch."""
    window = epoch_ns // window_ns
    bounds = group_offsets(window, tracklet)
    first, last = bounds[:-1], bounds[1:] - 1
    return (
        window[first],
        tracklet[first],
        np.full(len(first), sensor),
        epoch_ns[first],
        epoch_ns[last],
        np.diff(bounds),
    )


# Samples of views.


class SampledViews:
    """Clear views of some windows at their instants, and samples of them for the association."""

    def __init__(
        self, block: BlockViews, instants: Indices, agreeing_items: Indices | None = None
    ) -> None:
        """Read the views of a block at some epochs: of all items, or of those given."""
        views, tracklet = block.views_at(instants, agreeing_items)
        order = np.lexsort((tracklet, array(views, "epoch")))
        views, self.tracklet = views.take(order), tracklet[order]
        self.block = block
        self.epoch_ns = array(views, "epoch")
        self.u, self.r_km = stack(views, "u{}"), stack(views, "{}_km")
        self.w_rad_s = stack(views, "w{}_rad_s")
        self.noise = stack_covariance(views, "cov_noise_{}_rad2", TANGENT_AXES)
        self.bias = stack_covariance(views, "cov_bias_{}_rad2", TANGENT_AXES)
        self.sigma_km = array(views, "position_sigma_km")
        self.magnitude = array(views, "magnitude")
        self.width_s = (array(views, "last_fitted") - array(views, "first_fitted")) / 1e9

    def samples(self, instants: Indices, skipped: Indices) -> tuple[Samples, Indices]:
        """Return the samples of the tracklets at some epochs, and the tracklets' numbers.

        Views of the sensors `skipped` are left out.
        """
        rows = np.flatnonzero(np.isin(self.epoch_ns, instants))
        if len(skipped):
            rows = rows[~np.isin(self.block.sensor_of_tracklet[self.tracklet[rows]], skipped)]
        tracklet, item = np.unique(self.tracklet[rows], return_inverse=True)
        at = np.searchsorted(instants, self.epoch_ns[rows])
        t, k = len(tracklet), len(instants)
        seen, u = np.zeros((t, k), bool), np.tile([0.0, 0.0, 1.0], (t, k, 1))
        cov, sigma_km = np.tile(np.eye(2), (t, k, 1, 1)), np.ones((t, k))
        rate = np.zeros((t, k, 3))
        seen[item, at] = True
        u[item, at], rate[item, at] = self.u[rows], self.w_rad_s[rows]
        # All k samples share the common error. With k times its variance in each of them, it counts
        # once.
        n_samples = seen.sum(axis=1)[item].astype(float)
        width_s = np.zeros((t, k))
        width_s[item, at] = self.width_s[rows]
        repeated = repeated_samples(seen, (instants - instants[:1]) / 1e9, width_s)[item, at]
        cov[item, at] = (
            repeated[:, None, None] * self.noise[rows] + n_samples[:, None, None] * self.bias[rows]
        )
        sigma_km[item, at] = np.sqrt(n_samples) * self.sigma_km[rows]
        poses, fields = self.block.poses.at(instants), self.block.poses.fields_at(instants)
        sensor_km = poses.sensor_km.copy()
        sensor = self.block.sensor_of_tracklet[tracklet].astype(np.int64)
        sensor_km[sensor[item], at] = self.r_km[rows]
        start_ns, end_ns, origin = self.block.start_ns, self.block.end_ns, self.block.origin_ns
        return Samples(
            sensor=sensor,
            start_s=(start_ns[tracklet] - origin) / 1e9,
            end_s=(end_ns[tracklet] - origin) / 1e9,
            seen=seen,
            u=u,
            cov=cov,
            sigma_km=sigma_km,
            time_s=(instants - origin) / 1e9,
            sensor_km=sensor_km,
            R_sensor_from_icrs=poses.R_sensor_from_icrs,
            half_field=fields.half_field,
            rate=rate,
            sensor_km_s=poses.sensor_km_s,
            magnitude=_means(self.magnitude[rows], item, t),
            blend_rad=BLEND_PX / fields.focal_px,
        ), tracklet


def _means(values: Array, group: Indices, n: int) -> Array:
    """Return the mean of the known values of each of n groups, NaN without any."""
    known = np.isfinite(values)
    count = np.bincount(group[known], minlength=n)
    total = np.bincount(group[known], values[known], n)
    return np.divide(total, count, out=np.full(n, np.nan), where=count > 0)

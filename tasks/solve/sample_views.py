"""Sample views: the views of a span at a few instants, as arrays for the association."""

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import array, stack, stack_covariance
from epipole.schemas.columns import TANGENT_AXES
from epipole.tasks.algorithms.association.sampling.samples import Samples
from epipole.tasks.algorithms.association.verdicts import ViewKeys
from epipole.tasks.algorithms.geometry.rotations import matrix_from_quaternion
from epipole.tasks.common.sightings import camera_of, solved_frames

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

MOST_SAMPLES = 12  # instants in a window
BLENDED = 4.0  # times the noise: what blends may add makes a view useless to tell objects apart
NEAR_NS = 2_000_000_000  # a frame within this time gives the sensor's pose


class SpanViews:
    """The views of all sensors in a span as arrays, and samples of them at a few instants."""

    def __init__(
        self, views: pa.Table, tracklets: pa.Table, solutions: pa.Table, cameras: pa.Table
    ) -> None:
        tracklets = tracklets.sort_by("tracklet_id")
        self.tracklet_id = array(tracklets, "tracklet_id").astype(str)
        # Joined fragments are one track, by which an object keeps its number.
        _, self.track = np.unique(array(tracklets, "track_id").astype(str), return_inverse=True)
        self.sensors, self.sensor_of_tracklet = np.unique(
            array(tracklets, "sensor_id").astype(str), return_inverse=True
        )
        self.start_ns, self.end_ns = array(tracklets, "start_time"), array(tracklets, "end_time")
        self.epoch_ns = array(views, "epoch")
        self.missed = ~views["centroid"].is_valid().to_numpy()
        self.sensor = np.searchsorted(self.sensors, array(views, "sensor_id").astype(str))
        self.tracklet = np.searchsorted(self.tracklet_id, array(views, "tracklet_id").astype(str))
        self.u, self.r_km = stack(views, "u{}"), stack(views, "{}_km")
        self.w_rad_s = stack(views, "w{}_rad_s")
        self.noise = stack_covariance(views, "cov_noise_{}_rad2", TANGENT_AXES)
        self.bias = stack_covariance(views, "cov_bias_{}_rad2", TANGENT_AXES)
        self.sigma_km = array(views, "position_sigma_km")
        self.clear = self._clear(2 * array(views, "blend_rad2"))
        self._read_poses(solutions, cameras)

    def _read_poses(self, solutions: pa.Table, cameras: pa.Table) -> None:
        """Read each sensor's positions and attitudes, and its field of view."""
        self.frames, half_field, focal_px = [], [], []
        for sensor in self.sensors:
            frames = solved_frames(solutions.filter(pa.compute.field("sensor_id") == sensor))
            camera = camera_of(cameras, int(frames.camera[0]))
            self.frames.append((frames, matrix_from_quaternion(frames.q_sensor_from_icrs)))
            half_field.append((camera.width / camera.fx_px / 2, camera.height / camera.fy_px / 2))
            focal_px.append(camera.fx_px)
        self.half_field = np.array(half_field).reshape(-1, 2)
        self.focal_px = np.array(focal_px)

    def _clear(self, blend: Array) -> npt.NDArray[np.bool_]:
        """Return which views tell objects apart: `blend` adds little to their variance.

        The direction of the others may be of one object or of its neighbour. A group that is found
        without them has them as well. A tracklet that is a blend throughout is judged by its best
        views.
        """
        noise = np.trace(self.noise, axis1=1, axis2=2) - blend
        shared = np.trace(self.bias, axis1=1, axis2=2)
        return np.asarray(blend <= BLENDED * np.maximum(noise, shared))

    def windows(self, window_s: float) -> list[Indices]:
        """Return the rows of each window of time, in order; windows are counted from 1970."""
        if not len(self.epoch_ns):
            return []
        window = self.epoch_ns // max(round(window_s * 1e9), 1)
        cuts = np.flatnonzero(np.diff(window)) + 1
        return np.split(np.arange(len(window)), cuts)

    def keys(self, windows: list[Indices]) -> ViewKeys:
        """Return the epoch, window, tracklet and sensor of each row."""
        window = np.repeat(np.arange(len(windows)), [len(rows) for rows in windows])
        return ViewKeys(self.epoch_ns, window, self.tracklet, self.sensor)

    def samples(self, rows: Indices, instants: Indices, window_s: float) -> tuple[Samples, Indices]:
        """Return the samples of the tracklets at some epochs, and the tracklets' numbers.

        A view rests on the detections within `window_s` of its epoch, at most. Only clear views
        are sampled.
        """
        rows = rows[np.isin(self.epoch_ns[rows], instants) & self.clear[rows]]
        tracklet, item = np.unique(self.tracklet[rows], return_inverse=True)
        at = np.searchsorted(instants, self.epoch_ns[rows])
        t, k = len(tracklet), len(instants)
        seen, u = np.zeros((t, k), bool), np.tile([0.0, 0.0, 1.0], (t, k, 1))
        cov, sigma_km = np.tile(np.eye(2), (t, k, 1, 1)), np.ones((t, k))
        rate = np.zeros((t, k, 3))
        seen[item, at] = True
        u[item, at], rate[item, at] = self.u[rows], self.w_rad_s[rows]
        # The common error is one for all k samples. With k times its variance in each of them,
        # they count together as one.
        n_samples = seen.sum(axis=1)[item].astype(float)
        repeated = _repeated(seen, instants / 1e9, window_s)[item, at]
        cov[item, at] = (
            repeated[:, None, None] * self.noise[rows] + n_samples[:, None, None] * self.bias[rows]
        )
        sigma_km[item, at] = np.sqrt(n_samples) * self.sigma_km[rows]
        attitude, sensor_km, sensor_km_s = self._poses_at(instants)
        sensor_km[self.sensor[rows], at] = self.r_km[rows]
        origin = self.epoch_ns[0]
        return Samples(
            sensor=self.sensor_of_tracklet[tracklet].astype(np.int64),
            start_s=(self.start_ns[tracklet] - origin) / 1e9,
            end_s=(self.end_ns[tracklet] - origin) / 1e9,
            seen=seen,
            u=u,
            cov=cov,
            sigma_km=sigma_km,
            time_s=(instants - origin) / 1e9,
            sensor_km=sensor_km,
            R_sensor_from_icrs=attitude,
            half_field=self.half_field,
            rate=rate,
            sensor_km_s=sensor_km_s,
        ), tracklet

    def even_instants(self, rows: Indices, window_s: float) -> Indices:
        """Return a few epochs, evenly spaced and far enough apart to be independent.

        Two epochs within twice the half-window share detections.
        """
        epochs = np.unique(self.epoch_ns[rows])
        step = 2 * window_s * 1e9
        n = min(int(max((epochs[-1] - epochs[0]) // step, 1)), MOST_SAMPLES)
        edges = np.linspace(epochs[0], epochs[-1], n + 1)
        middle = (edges[1:] + edges[:-1]) / 2
        return np.unique([epochs[np.argmin(np.abs(epochs - m))] for m in middle])

    def instants(self, rows: Indices, window_s: float) -> Indices:
        """Return a few epochs of a window at which every tracklet has a view, if possible.

        They are evenly spaced, and the middle epoch of each tracklet without a view at those.
        """
        chosen = set(self.even_instants(rows, window_s).tolist())
        rows = rows[self.clear[rows]]
        for tracklet in np.unique(self.tracklet[rows]):
            epochs = self.epoch_ns[rows[self.tracklet[rows] == tracklet]]
            if len(chosen) < MOST_SAMPLES and not chosen.intersection(epochs.tolist()):
                chosen.add(int(epochs[len(epochs) // 2]))
        return np.array(sorted(chosen), np.int64)

    def _poses_at(self, instants: Indices) -> tuple[Array, Array, Array]:
        """Return the sensors' attitudes, positions, velocities; NaN where no frame is near."""
        attitude = np.full((len(self.sensors), len(instants), 3, 3), np.nan)
        sensor_km = np.full((len(self.sensors), len(instants), 3), np.nan)
        sensor_km_s = np.full_like(sensor_km, np.nan)
        for s, (frames, turned) in enumerate(self.frames):
            near = np.clip(np.searchsorted(frames.time_ns, instants), 0, len(turned) - 1)
            there = np.abs(frames.time_ns[near] - instants) < NEAR_NS
            attitude[s, there] = turned[near[there]]
            sensor_km[s, there] = frames.r_gcrf_km[near[there]]
            sensor_km_s[s, there] = frames.v_gcrf_km_s[near[there]]
        return attitude, sensor_km, sensor_km_s


def _repeated(seen: npt.NDArray[np.bool_], time_s: Array, window_s: float) -> Array:
    """Return how many samples of its tracklet each sample repeats, itself included, (t, k).

    Samples nearer than twice the half-window share detections, and with them their errors. With
    the noise so many times larger, they count together as what is independent.

    Parameters
    ----------
    seen : (t, k) bool
        Whether tracklet t has a sample at instant k.
    time_s : (k,) float
        The instants [s].
    """
    apart = np.abs(time_s[:, None] - time_s[None, :])
    shared = np.maximum(1 - apart / max(2 * window_s, 1e-9), 0.0)
    np.fill_diagonal(shared, 1.0)
    return seen.astype(float) @ shared

"""Sample views: the views of a block at a few instants, as arrays for the association."""

import numpy as np
import numpy.typing as npt

from epipole.schemas.bridge import array, stack, stack_covariance
from epipole.schemas.columns import TANGENT_AXES
from epipole.tasks.algorithms.association.sampling.samples import Samples
from epipole.tasks.solve.association.block_views import BlockViews

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


class SampledViews:
    """Clear views of some windows at their instants, and samples of them for the association."""

    def __init__(
        self, block: BlockViews, instants: Indices, believed_items: Indices | None = None
    ) -> None:
        """Read the views of a block at some epochs: of all items, or of those believed."""
        views, tracklet = block.views_at(instants, believed_items)
        order = np.lexsort((tracklet, array(views, "epoch")))
        views, self.tracklet = views.take(order), tracklet[order]
        self.block = block
        self.epoch_ns = array(views, "epoch")
        self.u, self.r_km = stack(views, "u{}"), stack(views, "{}_km")
        self.w_rad_s = stack(views, "w{}_rad_s")
        self.noise = stack_covariance(views, "cov_noise_{}_rad2", TANGENT_AXES)
        self.bias = stack_covariance(views, "cov_bias_{}_rad2", TANGENT_AXES)
        self.sigma_km = array(views, "position_sigma_km")

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
        # The common error is one for all k samples. With k times its variance in each of them,
        # they count together as one.
        n_samples = seen.sum(axis=1)[item].astype(float)
        repeated = _repeated(seen, instants / 1e9, self.block.half_width_s)[item, at]
        cov[item, at] = (
            repeated[:, None, None] * self.noise[rows] + n_samples[:, None, None] * self.bias[rows]
        )
        sigma_km[item, at] = np.sqrt(n_samples) * self.sigma_km[rows]
        poses = self.block.poses.at(instants)
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
            half_field=self.block.poses.half_field,
            rate=rate,
            sensor_km_s=poses.sensor_km_s,
        ), tracklet


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

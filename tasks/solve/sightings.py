"""Tracklet sightings: one sensor's detections by tracklet, with errors that the log does not state.

The detections together show three errors: the part of a prior attitude's error that changes from
frame to frame, that of a trail along its motion in the sky or in the image, and the shift of a
centroid by the light of a neighbour.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.arrays import Array, Indices
from epipole.schemas.bridge import array, empty, nullable, table, unstack, unstack_covariance
from epipole.schemas.columns import ATTRIBUTABLE_AXES
from epipole.schemas.settings import TrackletSettings
from epipole.schemas.spans import Span
from epipole.schemas.work_tables import ATTRIBUTABLES, SIGHTINGS
from epipole.tasks.algorithms.constants import ARCSEC, SECOND_NS
from epipole.tasks.algorithms.earth_gravity import propagate_states
from epipole.tasks.algorithms.geometry.covariances import (
    attitude_covariance,
    centroid_covariance,
    few_stars_covariance,
    in_components,
    scatter_beyond,
    shared_direction_covariance,
    traces,
)
from epipole.tasks.algorithms.geometry.directions import (
    aberrate,
    east_north,
    lengths,
    matrix_from_quaternion,
    radec_from_unit,
)
from epipole.tasks.algorithms.geometry.turning import angular_rates
from epipole.tasks.algorithms.photometry import FluxScale
from epipole.tasks.algorithms.tracking.attributables import attributables
from epipole.tasks.algorithms.tracking.blends import TrackedDetections, blend_variance, of_neighbour
from epipole.tasks.algorithms.tracking.image_trails import trail_time2
from epipole.tasks.algorithms.tracking.local_motion import directions_at
from epipole.tasks.algorithms.tracking.trails import AlongMotion, along_motion, time_error
from epipole.tasks.common.grouping import factorize, group_offsets
from epipole.tasks.common.sightings import (
    Frames,
    by_camera,
    camera_of,
    in_lone_frames,
    optics_covariance_of,
    sightings_of,
    solved_frames,
    with_lone_detections,
)

# Tracklets that show the error of a trail: of this rate [rad/s], at which the 2 ms of a simulated
# tracker are a twentieth of its centroid's error, and five detections at least.
TRAIL_RAD_S, MIN_TRAILS = np.radians(0.1), 5
# And those that show one in the image: slower ones leave trails of a tenth of a pixel or two.
IMAGE_TRAIL_RAD_S = np.radians(0.02)
# Of the way from a frame to a time near it: right to a metre over a minute of a low orbit.
STEPS_TO_FRAME = 2


class TrackletSightings(NamedTuple):
    """Sightings sorted by tracklet, then frame.

    Tracklet k has the rows ``bounds[k]:bounds[k + 1]``, and the id ``name[k]``. `blend_rad2` is a
    part of `cov_bias`: the variance per axis that the light of a neighbour may add. `turn_rad2` is
    a part of `cov_noise`: that of the attitude, which all detections of a frame share.
    """

    frame: Indices
    time_ns: Indices
    centroid: Indices
    u_icrs: Array
    cov_noise: Array
    cov_bias: Array
    blend_rad2: Array
    turn_rad2: Array
    flux: Array
    bounds: Indices
    name: npt.NDArray[np.object_]

    @property
    def tracklet(self) -> Indices:
        """Tracklet of each row."""
        return np.repeat(np.arange(len(self.name)), np.diff(self.bounds))


class SensorSightings(NamedTuple):
    """The sightings of one sensor, its frames and its CAMERAS, whose rows `frames` name.

    `magnitude` and `magnitude_sigma` (n,) are of the sightings, NaN where unknown.
    """

    frames: Frames
    tracklets: TrackletSightings
    cameras: pa.Table
    magnitude: Array
    magnitude_sigma: Array


def sight_objects(
    solutions: pa.Table,
    detections: pa.Table,
    cameras: pa.Table,
    settings: TrackletSettings,
    half_width_s: float,
) -> SensorSightings | None:
    """Return the sightings of one sensor's detections that have a tracklet and a direction.

    A detection in a lone frame is a tracklet of one detection. None without such detections.

    Parameters
    ----------
    half_width_s
        Time on each side of a detection in which its apparent motion is fitted.
    """
    frames = solved_frames(solutions)
    detections = _with_lone(frames, detections, settings)
    # Detections without a direction were tracked in the image alone.
    has_direction = (
        pa.compute.field("tracklet_id").is_valid() & pa.compute.field("ra_deg").is_valid()
    )
    tracked = detections.filter(has_direction)
    if not tracked.num_rows:
        return None
    tracklets = _with_split_prior(_by_tracklet(frames, tracked, cameras), frames, half_width_s)
    tracklets = _with_trails(tracklets, frames)
    tracklets = _with_image_trails(tracklets, frames, half_width_s)
    tracklets = _with_blends(tracklets, frames, cameras)
    return SensorSightings(frames, tracklets, cameras, *_magnitudes(frames, tracklets))


def _magnitudes(frames: Frames, tracklets: TrackletSightings) -> tuple[Array, Array]:
    """Return the magnitude of each sighting and its 1-sigma error; NaN where unknown."""
    of_frames = (
        array(frames.table, name).astype(float)[tracklets.frame]
        for name in ("zero_mag", "zero_variance_mag2", "flux_floor_mag2", "flux_photon_mag2")
    )
    return FluxScale(*of_frames).magnitudes(tracklets.flux)


class OpticsCovariances(NamedTuple):
    """Covariances of directions, ICRS, due to the error of fitted optics: (n, 3, 3) each [rad^2].

    Both are shared by all frames. `turn` is that of the attitude, which turns all directions alike:
    from few stars it compensates the optics less well than from many. `local` differs from part to
    part of the field.
    """

    local: Array
    turn: Array

    @property
    def whole(self) -> Array:
        """Both together."""
        return self.local + self.turn


def optics_covariance(
    sightings: SensorSightings, R: Array, u_sensor: Array, frame: Indices
) -> OpticsCovariances:
    """Return the covariances of directions due to the error of fitted optics.

    They are 0 where the optics are those of the log. Each frame has its camera: a calibration may
    change.

    Parameters
    ----------
    R : (n, 3, 3) float
        Attitudes, sensor from ICRS.
    u_sensor : (n, 3) float
        Measured directions, sensor axes.
    frame : (n,) int
        Their frames.
    """
    frames, out = sightings.frames, OpticsCovariances(np.zeros_like(R), np.zeros_like(R))
    for row, at in by_camera(frames.camera[frame]):
        cov_optics = optics_covariance_of(sightings.cameras, row)
        if not cov_optics.any():
            continue
        camera, u = camera_of(sightings.cameras, row), u_sensor[at]
        from_stars, stars = frames.from_stars[frame[at]], array(frames.table, "n_stars")[frame[at]]
        local = shared_direction_covariance(camera, cov_optics, u, from_stars)
        n_stars = np.where(from_stars, np.maximum(stars, 1), np.inf)
        of_attitude = few_stars_covariance(camera, cov_optics) / n_stars[:, None, None]
        back = np.swapaxes(R[at], 1, 2)
        out.local[at] = in_components(back, local)
        out.turn[at] = in_components(back, attitude_covariance(u, of_attitude))
    return out


def _with_lone(frames: Frames, detections: pa.Table, settings: TrackletSettings) -> pa.Table:
    """Return the detections; each unknown one in a lone frame gets the id of a new tracklet."""
    lone_frames = frames.number[in_lone_frames(frames.time_ns, settings)]
    if not len(lone_frames):
        return detections
    unknown = array(detections, "kind") == "unknown"
    lone = unknown & np.isin(array(detections, "frame_number"), lone_frames)
    return with_lone_detections(detections, lone)


def _by_tracklet(frames: Frames, tracked: pa.Table, cameras: pa.Table) -> TrackletSightings:
    sightings = sightings_of(frames, tracked, cameras)
    rank, names = factorize(tracked, "tracklet_id")
    rank = rank[sightings.row]
    order = np.lexsort((sightings.frame, rank))
    bounds = group_offsets(rank[order])
    centroid_rad2 = (array(tracked, "sigma_arcsec")[sightings.row] * ARCSEC) ** 2
    turn_rad2 = traces(sightings.cov_noise) / 2 - centroid_rad2
    return TrackletSightings(
        sightings.frame[order],
        sightings.time_ns[order],
        array(tracked, "centroid")[sightings.row[order]],
        sightings.u_icrs[order],
        sightings.cov_noise[order],
        sightings.cov_bias[order],
        np.zeros(len(order)),
        np.maximum(turn_rad2, 0.0)[order],
        array(tracked, "flux").astype(float)[sightings.row[order]],
        bounds,
        names[rank[order[bounds[:-1]]]].astype(object),
    )


def _with_blends(
    tracklets: TrackletSightings, frames: Frames, cameras: pa.Table
) -> TrackletSightings:
    """Return the sightings with the errors that the light of neighbours may add.

    Sightings that show only a neighbour are left out.
    """
    time_s = (frames.time_ns - frames.time_ns[0]) / 1e9
    tracked = TrackedDetections(
        tracklets.bounds,
        time_s[tracklets.frame],
        tracklets.u_icrs,
        tracklets.cov_noise,
        tracklets.flux,
    )
    pixel_rad = np.empty(len(time_s))
    for row, at in by_camera(frames.camera):
        pixel_rad[at] = camera_of(cameras, row).pixel_rad
    variance = blend_variance(tracked, time_s, pixel_rad)
    cov_bias = tracklets.cov_bias + centroid_covariance(tracklets.u_icrs, np.sqrt(variance))
    of_object = ~of_neighbour(tracked, variance)
    left = np.concatenate([[0], np.cumsum(of_object)])
    return TrackletSightings(
        tracklets.frame[of_object],
        tracklets.time_ns[of_object],
        tracklets.centroid[of_object],
        tracklets.u_icrs[of_object],
        tracklets.cov_noise[of_object],
        cov_bias[of_object],
        variance[of_object],
        tracklets.turn_rad2[of_object],
        tracklets.flux[of_object],
        left[tracklets.bounds],
        tracklets.name,
    )


def _with_split_prior(
    tracklets: TrackletSightings, frames: Frames, half_width_s: float
) -> TrackletSightings:
    """Return the sightings with each prior attitude's error divided into noise and bias.

    Detections scatter about the smooth motion of objects by the part of the error that changes from
    frame to frame: it is noise. The rest of the stated variance is the bias that all frames share.
    It is not less than the error of the division.
    """
    prior = np.flatnonzero(~frames.from_stars[tracklets.frame])
    if not len(prior):
        return tracklets
    about = _about_motion(tracklets, frames, prior, half_width_s)
    tracklet = tracklets.tracklet[prior]
    follows = np.append(False, (np.diff(tracklet) == 0) & (np.diff(prior) == 1))
    scatter = scatter_beyond(about.miss, np.sqrt(about.noise_rad2), about.leverage, follows)
    stated = traces(tracklets.cov_bias)[prior] / 2
    share = scatter / np.maximum(stated, 1e-30)
    n_frames = len(np.unique(tracklets.frame[prior]))
    stays = np.maximum(1.0 - share, share / np.sqrt(n_frames))
    noise, bias = tracklets.cov_noise.copy(), tracklets.cov_bias.copy()
    turn_rad2 = tracklets.turn_rad2.copy()
    noise[prior] += share[:, None, None] * bias[prior]
    turn_rad2[prior] += share * stated
    bias[prior] *= stays[:, None, None]
    return tracklets._replace(cov_noise=noise, cov_bias=bias, turn_rad2=turn_rad2)


class _AboutMotion(NamedTuple):
    """Some sightings about the smooth motions of their tracklets.

    miss : (n, 3) float, directions minus those of the motions [rad]
    w : (n, 3) float, rates of the motions [rad/s]
    noise_rad2 : (n,) float, variances of the directions per axis
    leverage : (n,) float, weights of the directions in the motions
    """

    miss: Array
    w: Array
    noise_rad2: Array
    leverage: Array


def _about_motion(
    tracklets: TrackletSightings, frames: Frames, rows: Indices, half_width_s: float
) -> _AboutMotion:
    v = np.nan_to_num(frames.v_gcrf_km_s)
    u = aberrate(tracklets.u_icrs, -v[tracklets.frame])
    tracklet = tracklets.tracklet[rows]
    time_s = (tracklets.time_ns - frames.time_ns[0]) / 1e9
    fit = directions_at(
        tracklets.bounds[tracklet], tracklets.bounds[tracklet + 1], time_s[rows], 0.0, time_s, u,
        tracklets.cov_noise, tracklets.cov_bias, half_width_s,
    )  # fmt: skip
    noise_rad2 = traces(tracklets.cov_noise)[rows] / 2
    leverage = (traces(fit.cov_noise) / 2 - fit.unmodelled) / noise_rad2
    return _AboutMotion(u[rows] - fit.u, fit.w, noise_rad2, leverage)


def _with_trails(tracklets: TrackletSightings, frames: Frames) -> TrackletSightings:
    """Return the sightings with the error of fast objects along their motion, see `trails`."""
    bounds, u = tracklets.bounds, tracklets.u_icrs
    time_s = (tracklets.time_ns - frames.time_ns[0]) / 1e9
    first, last = bounds[:-1], bounds[1:] - 1
    moved = np.linalg.norm(u[last] - u[first], axis=1)
    fast = (last - first >= MIN_TRAILS - 1) & (moved > TRAIL_RAD_S * (time_s[last] - time_s[first]))
    if not fast.any():
        return tracklets
    parts = [slice(bounds[k], bounds[k + 1]) for k in np.flatnonzero(fast)]
    motions = [along_motion(time_s[part], u[part]) for part in parts]
    motion = AlongMotion(*(np.concatenate(each) for each in zip(*motions, strict=True)))
    rows = np.flatnonzero(np.repeat(fast, np.diff(bounds)))
    noise = tracklets.cov_noise.copy()
    variance = (noise[rows] * motion.along[:, :, None] * motion.along[:, None]).sum(axis=(1, 2))
    error = motion.along * (motion.rate_rad_s * time_error(motion, variance))[:, None]
    noise[rows] += error[:, :, None] * error[:, None, :]
    return tracklets._replace(cov_noise=noise)


def _with_image_trails(
    tracklets: TrackletSightings, frames: Frames, half_width_s: float
) -> TrackletSightings:
    """Return the sightings with the error along their motion through the image that their scatter
    shows beyond the other errors, see `image_trails`."""
    R = matrix_from_quaternion(frames.q_sensor_from_icrs)
    in_image = np.einsum("nij,nj->ni", R[tracklets.frame], tracklets.u_icrs)
    time_s = (tracklets.time_ns - frames.time_ns[0]) / 1e9
    rows = _that_move(in_image, time_s, tracklets.bounds)
    if not len(rows):
        return tracklets
    about, frame = _about_motion(tracklets, frames, rows, half_width_s), tracklets.frame[rows]
    frame_s = (frames.time_ns - frames.time_ns[0]) / 1e9
    by_turn = np.cross(angular_rates(frame_s, R, np.ones(len(R), bool))[frame], in_image[rows])
    moves = about.w + np.einsum("nji,nj->ni", R[frame], by_turn)
    time2 = trail_time2(about.miss, moves, tracklets.cov_noise[rows], about.leverage)
    if not time2:
        return tracklets
    noise = tracklets.cov_noise.copy()
    noise[rows] += time2 * moves[:, :, None] * moves[:, None, :]
    return tracklets._replace(cov_noise=noise)


def _that_move(in_image: Array, time_s: Array, bounds: Indices) -> Indices:
    """Return the rows of the tracklets that move through the image by `IMAGE_TRAIL_RAD_S`."""
    moved = lengths(np.diff(in_image, axis=0))
    way = np.concatenate([[0.0], np.cumsum(moved)])
    first, last = bounds[:-1], bounds[1:] - 1
    fast = way[last] - way[first] > IMAGE_TRAIL_RAD_S * (time_s[last] - time_s[first])
    return np.flatnonzero(np.repeat(fast, np.diff(bounds)))


# Tables of observations and attributables.


def tabulate_sightings(sightings: SensorSightings | None) -> pa.Table:
    """Return SIGHTINGS of one sensor, sorted by time: those of frames with a known position."""
    if sightings is None:
        return empty(SIGHTINGS)
    frames, tracklets = sightings.frames, sightings.tracklets
    frame = tracklets.frame
    u = aberrate(tracklets.u_icrs, -np.nan_to_num(frames.v_gcrf_km_s[frame]))
    ra, dec = radec_from_unit(u)
    noise = _on_sky(u, _noise(sightings, u))
    sigma = np.sqrt(np.diagonal(noise, axis1=1, axis2=2))
    r_km, v_km_s = _states_at_rows(frames, tracklets)
    columns = {
        "time": tracklets.time_ns,
        "sensor_id": array(frames.table, "sensor_id")[frame],
        "frame_number": frames.number[frame],
        "centroid": tracklets.centroid,
        "ra_deg": np.degrees(ra),
        "dec_deg": np.degrees(dec),
        "sigma_ra_arcsec": sigma[:, 0] / ARCSEC,
        "sigma_dec_arcsec": sigma[:, 1] / ARCSEC,
        "correlation": noise[:, 0, 1] / (sigma[:, 0] * sigma[:, 1]),
        "bias_sigma_arcsec": _bias_sigma(sightings, np.arange(len(u))) / ARCSEC,
        "blended": tracklets.blend_rad2 > 0.0,
        **unstack("{}_km", r_km),
        "position_sigma_km": frames.position_sigma_km[frame],
        "tracklet_id": tracklets.name[tracklets.tracklet],
    }
    kept = np.flatnonzero(np.isfinite(r_km[:, 0]))
    kept = kept[np.argsort(tracklets.time_ns[kept], kind="stable")]
    maybe = {
        "magnitude": sightings.magnitude,
        "magnitude_sigma": sightings.magnitude_sigma,
        **unstack("v{}_km_s", v_km_s),
    }
    return table(
        SIGHTINGS,
        {name: values[kept] for name, values in columns.items()}
        | {name: nullable(values[kept]) for name, values in maybe.items()},
    )


def _states_at_rows(frames: Frames, tracklets: TrackletSightings) -> tuple[Array, Array]:
    """Return the sensor's positions and velocities at the times of sightings."""
    late_ns = tracklets.time_ns - frames.time_ns[tracklets.frame]
    if not late_ns.any():
        return frames.r_gcrf_km[tracklets.frame], frames.v_gcrf_km_s[tracklets.frame]
    return states_near_frames(frames, tracklets.frame, -late_ns / SECOND_NS)


def _noise(sightings: SensorSightings, u: Array) -> Array:
    """Return the errors (n, 3, 3) of directions that are independent in each frame [rad^2]."""
    blend = centroid_covariance(u, np.sqrt(sightings.tracklets.blend_rad2))
    return sightings.tracklets.cov_noise + blend


def _bias_sigma(sightings: SensorSightings, rows: Indices) -> Array:
    """Return the 1-sigma error per axis [rad] that sightings of a sensor share."""
    frames, tracklets = sightings.frames, sightings.tracklets
    frame, u_icrs = tracklets.frame[rows], tracklets.u_icrs[rows]
    R = matrix_from_quaternion(frames.q_sensor_from_icrs[frame])
    u_sensor = np.einsum("nij,nj->ni", R, u_icrs)
    shared = tracklets.cov_bias[rows] + optics_covariance(sightings, R, u_sensor, frame).whole
    trace = traces(shared) - 2 * tracklets.blend_rad2[rows]
    return np.sqrt(np.maximum(trace / 2, 0.0))


def with_middle_in(tracklets: pa.Table, span: Span) -> pa.Table:
    """Return the tracklets whose middle is in a span."""
    middle = (array(tracklets, "start_time") + array(tracklets, "end_time")) // 2
    return tracklets.filter(pa.array(span.holds(middle)))


def tabulate_attributables(sightings: SensorSightings | None, tracklets: pa.Table) -> pa.Table:
    """Return ATTRIBUTABLES of one sensor's tracklets.

    Parameters
    ----------
    tracklets
        Those with a middle in the span: ids and ends.
    """
    if sightings is None or not tracklets.num_rows:
        return empty(ATTRIBUTABLES)
    frames, grouped = sightings.frames, sightings.tracklets
    names = array(tracklets, "tracklet_id")
    middle = (array(tracklets, "start_time") + array(tracklets, "end_time")) // 2
    by_name = {name: row for row, name in enumerate(grouped.name)}
    number = np.array([by_name.get(name, -1) for name in names], np.int64)
    names, middle, number = names[number >= 0], middle[number >= 0], number[number >= 0]
    origin, time_ns = frames.time_ns[0], grouped.time_ns
    u = aberrate(grouped.u_icrs, -np.nan_to_num(frames.v_gcrf_km_s[grouped.frame]))
    fit = attributables(
        np.stack([grouped.bounds[number], grouped.bounds[number + 1]], axis=1),
        (middle - origin) / 1e9,
        (time_ns - origin) / 1e9,
        u,
        _noise(sightings, u),
    )
    nearest = _nearest(time_ns, grouped.bounds, number, middle)
    ra, dec = radec_from_unit(fit.u)
    east, north = np.moveaxis(east_north(fit.u), 1, 0)
    frame = grouped.frame[nearest]
    dt_s = (frames.time_ns[frame] - middle) / 1e9  # a row may be exposed at another time
    r_km, v_km_s = states_near_frames(frames, frame, dt_s)
    columns = {
        "ra_deg": np.degrees(ra),
        "dec_deg": np.degrees(dec),
        "ra_rate_arcsec_s": np.einsum("ni,ni->n", fit.w, east) / ARCSEC,
        "dec_rate_arcsec_s": np.einsum("ni,ni->n", fit.w, north) / ARCSEC,
        **unstack_covariance("cov_{}", fit.cov / ARCSEC**2, ATTRIBUTABLE_AXES),
        "bias_sigma_arcsec": _bias_sigma(sightings, nearest) / ARCSEC,
        **unstack("{}_km", r_km),
        **unstack("v{}_km_s", v_km_s),
        "position_sigma_km": frames.position_sigma_km[frame],
        **_mean_magnitudes(sightings, number),
    }
    return table(
        ATTRIBUTABLES,
        {"tracklet_id": names, "epoch": middle}
        | {name: nullable(values) for name, values in columns.items()},
    )


def _nearest(time_ns: Indices, bounds: Indices, number: Indices, at_ns: Indices) -> Indices:
    """Return the sighting of each tracklet that is nearest to a time."""
    rows = [
        bounds[k] + np.argmin(np.abs(time_ns[bounds[k] : bounds[k + 1]] - at))
        for k, at in zip(number.tolist(), at_ns.tolist(), strict=True)
    ]
    return np.array(rows, np.int64)


def _mean_magnitudes(sightings: SensorSightings, number: Indices) -> dict[str, Array]:
    """Return the mean magnitudes of tracklets, their errors and scatter; NaN where unknown."""
    tracklets = sightings.tracklets
    magnitude, sigma = sightings.magnitude, sightings.magnitude_sigma
    known, n = np.isfinite(magnitude) & (sigma > 0), len(tracklets.name)
    weight = np.where(known, 1 / np.where(known, sigma, 1.0) ** 2, 0.0)
    value = np.where(known, magnitude, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = np.bincount(tracklets.tracklet, weight, n)
        count = np.bincount(tracklets.tracklet, known, n)
        mean = np.bincount(tracklets.tracklet, weight * value, n) / total
        square = np.bincount(tracklets.tracklet, known * (value - mean[tracklets.tracklet]) ** 2, n)
        scatter = np.sqrt(square / np.where(count > 1, count - 1, np.nan))
        of_mean = np.fmax(np.sqrt(1 / total), scatter / np.sqrt(count))
    columns = {
        "magnitude": mean,
        "magnitude_sigma": np.where(count > 0, of_mean, np.nan),
        "magnitude_scatter": scatter,
    }
    return {name: values[number] for name, values in columns.items()}


def states_near_frames(frames: Frames, served: Indices, dt_s: Array) -> tuple[Array, Array]:
    """Return the sensor's positions and velocities at times near frames, from those at the frames.

    Under the Earth's gravity; what stands on the ground does not fall. An unknown velocity
    counts as zero, and stays unknown.

    Parameters
    ----------
    served : (n,) int
        The frame of each of the times.
    dt_s : (n,) float
        Time of the frame minus the given time [s].
    """
    r, v = frames.r_gcrf_km[served], frames.v_gcrf_km_s[served]
    moved, faster = propagate_states(r, np.nan_to_num(v), -dt_s, STEPS_TO_FRAME)
    return moved, np.where(np.isnan(v), np.nan, faster)


def _on_sky(u: Array, cov: Array) -> Array:
    """Return (n, 3, 3) covariances as (n, 2, 2), east and north."""
    return in_components(east_north(u), cov)

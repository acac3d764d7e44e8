"""Tabulate sightings: each detection of a tracklet as an observation, its object still unknown."""

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.bridge import array, empty, nullable, table, unstack
from epipole.schemas.work_tables import SIGHTINGS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.direction_errors import centroid_covariance
from epipole.tasks.algorithms.geometry.rotations import matrix_from_quaternion
from epipole.tasks.algorithms.geometry.sky import aberrate, east_north, radec_from_unit
from epipole.tasks.algorithms.photometry import FluxScale
from epipole.tasks.solve.views.tracklet_sightings import Sighted, optics_covariance

Array = npt.NDArray[np.float64]


def tabulate_sightings(sighted: Sighted | None) -> pa.Table:
    """Return SIGHTINGS of one sensor, sorted by time; of frames whose sensor has a position."""
    if sighted is None:
        return empty(SIGHTINGS)
    frames, tracklets = sighted.frames, sighted.tracklets
    frame = tracklets.frame
    v_km_s = frames.v_gcrf_km_s[frame]
    u = aberrate(tracklets.u_icrs, -np.nan_to_num(v_km_s))
    ra, dec = radec_from_unit(u)
    cov_blend = centroid_covariance(u, np.sqrt(tracklets.blend_rad2))
    noise = _on_sky(u, tracklets.cov_noise + cov_blend)
    R = matrix_from_quaternion(frames.q_sensor_from_icrs[frame])
    u_sensor = np.einsum("nij,nj->ni", R, tracklets.u_icrs)
    by_optics = optics_covariance(sighted, R, u_sensor, frames.from_stars[frame])
    shared = _on_sky(u, tracklets.cov_bias - cov_blend + by_optics)
    sigma = np.sqrt(np.diagonal(noise, axis1=1, axis2=2))
    r_km = frames.r_gcrf_km[frame]
    magnitude, magnitude_sigma = _magnitudes(sighted)
    columns = {
        "time": frames.time_ns[frame],
        "sensor_id": array(frames.table, "sensor_id")[frame],
        "frame_number": frames.number[frame],
        "centroid": tracklets.centroid,
        "ra_deg": np.degrees(ra),
        "dec_deg": np.degrees(dec),
        "sigma_ra_arcsec": sigma[:, 0] / ARCSEC,
        "sigma_dec_arcsec": sigma[:, 1] / ARCSEC,
        "correlation": noise[:, 0, 1] / (sigma[:, 0] * sigma[:, 1]),
        "bias_sigma_arcsec": np.sqrt(np.maximum(np.trace(shared, axis1=1, axis2=2) / 2, 0.0))
        / ARCSEC,
        **unstack("{}_km", r_km),
        "position_sigma_km": frames.position_sigma_km[frame],
        "tracklet_id": tracklets.name[tracklets.tracklet],
    }
    kept = np.flatnonzero(np.isfinite(r_km[:, 0]))
    kept = kept[np.argsort(frames.time_ns[frame[kept]], kind="stable")]
    maybe = {
        "magnitude": magnitude,
        "magnitude_sigma": magnitude_sigma,
        **unstack("v{}_km_s", v_km_s),
    }
    return table(
        SIGHTINGS,
        {name: values[kept] for name, values in columns.items()}
        | {name: nullable(values[kept]) for name, values in maybe.items()},
    )


def _on_sky(u: Array, cov: Array) -> Array:
    """Return (n, 3, 3) covariances as (n, 2, 2), east and north."""
    basis = east_north(u)
    return basis @ cov @ np.swapaxes(basis, 1, 2)


def _magnitudes(sighted: Sighted) -> tuple[Array, Array]:
    frames, tracklets = sighted.frames, sighted.tracklets
    of_frames = (
        array(frames.table, name).astype(float)[tracklets.frame]
        for name in ("zero_mag", "zero_variance_mag2", "flux_floor_mag2", "flux_photon_mag2")
    )
    return FluxScale(*of_frames).magnitudes(tracklets.flux)

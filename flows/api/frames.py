"""One frame: its stars and attitude, and the directions of the other detections."""

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.flows.api.arguments import (
    Time,
    floats,
    optics,
    position,
    sigma,
    time_ns,
    unit_quaternion,
    velocity,
)
from epipole.flows.api.objects import View
from epipole.io.catalogues.star_catalogue import read_star_catalogue
from epipole.schemas.arrays import Array, Integers
from epipole.schemas.bridge import (
    array,
    nullable,
    stack,
    stack_covariance,
    table,
    unstack,
    unstack_covariance,
)
from epipole.schemas.columns import OPTICS_AXES
from epipole.schemas.settings import Settings
from epipole.schemas.work_tables import CAMERAS, EXPOSURES, SENSOR_STATES_AT_FRAMES
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.camera import Camera, pixel_angle, unproject
from epipole.tasks.algorithms.geometry.covariances import (
    attitude_covariance,
    centroid_covariance,
    on_tangent_plane,
)
from epipole.tasks.algorithms.geometry.directions import aberrate, matrix_from_quaternion
from epipole.tasks.identify.identify_stars import identify_stars


class IdentifiedFrame(NamedTuple):
    """The stars and the attitude of one frame of n centroids.

    Attributes
    ----------
    star_id : (n,) int
        The star of each centroid: its Hipparcos number (or that of the catalogue); -1: no star.
    attitude_xyzw : (4,) float
        Unit quaternion, scalar last, that turns ICRS into sensor axes; NaN without attitude.
    attitude_cov_arcsec2 : (3, 3) float
        Covariance of the small rotation about the sensor's axes [arcsec^2]; with the error of an
        unknown velocity, but not that of the optics.
    source : str
        Where the attitude comes from: "stars", "prior" or "none".
    status : str or None
        Why there is no attitude from stars, as in the table `frames`; None if it has one.
    residual_px : float
        Rms of the star residuals per axis [px]; NaN without stars.
    """

    star_id: Integers
    attitude_xyzw: Array
    attitude_cov_arcsec2: Array
    source: str
    status: str | None
    residual_px: float


def identify_frame(
    x_px: npt.ArrayLike,
    y_px: npt.ArrayLike,
    flux: npt.ArrayLike | None = None,
    *,
    camera: Camera,
    time: Time,
    sigma_px: npt.ArrayLike | None = None,
    velocity_km_s: npt.ArrayLike | None = None,
    prior_xyzw: npt.ArrayLike | None = None,
    prior_sigma_arcsec: float | None = None,
    settings: Settings | None = None,
) -> IdentifiedFrame:
    """Return which centroids of a frame are stars, and the attitude with its covariance.

    Parameters
    ----------
    x_px, y_px : (n,) float
        Columns and rows of the centroids [px]; (0, 0) is the middle of the top-left pixel.
    flux : (n,) float, optional
        Linear, in any unit. It helps much.
    camera : Camera
        The sensor's optics.
    time : datetime, numpy.datetime64, str or int
        Middle of the exposure, UTC; an int is nanoseconds since 1970.
    sigma_px : float or (n,) float, optional
        1-sigma errors of the centroids per axis [px]. None: estimated from the stars.
    velocity_km_s : (3,) float, optional
        Velocity of the sensor, GCRF. None: that of the Earth; the attitude is then off by the
        aberration, up to 5 arcsec in a low orbit. Its covariance has that error: 3 arcsec about
        each axis across the boresight.
    prior_xyzw : (4,) float, optional
        A prior attitude, sensor from ICRS. None: the whole sky is searched.
    prior_sigma_arcsec : float, optional
        Its 1-sigma error, per axis. None, or 0: that of the settings.
    settings : epipole.schemas.settings.Settings, optional
        Those of a run: catalogue, false-alarm probability and so on.

    Returns
    -------
    IdentifiedFrame
        Where the sky is not found, `status` says why; no error is raised.

    Raises
    ------
    ValueError
        Where arrays differ in length, a value is not a number, an integer for the time is before
        1972, `prior_sigma_arcsec` is below 0, or a log with this camera would be refused.

    Notes
    -----
    One frame by itself: the limits of the sensor are not learned from its other frames, as a run
    does it. The first call reads the catalogue and may compile for a minute.

    Examples
    --------
    A frame of the example, lost in space:

    >>> from epipole.flows import api
    >>> log = api.read_log("examples/four_sensor_geo.mcap")
    >>> frame = log.frames.row(0, named=True)
    >>> fields = log.cameras.select(api.Camera._fields).row(0, named=True)
    >>> found = api.identify_frame(
    ...     frame["x_px"], frame["y_px"], frame["flux"],
    ...     camera=api.Camera(**fields), time=frame["time"],
    ... )
    >>> found.source, int((found.star_id >= 0).sum()), found.attitude_xyzw.shape
    ('stars', 8, (4,))
    """
    x = floats("x_px", x_px, "n")
    n = len(x)
    y = floats("y_px", y_px, n)
    at_ns = time_ns(time)
    exposures = _one_row(
        EXPOSURES,
        at_ns,
        x_px=[x],
        y_px=[y],
        flux=[None if flux is None else floats("flux", flux, n)],
        sigma_px=[None if sigma_px is None else floats("sigma_px", sigma_px, n, repeat=True)],
    )
    state = unstack("v{}_km_s", velocity(velocity_km_s, default=np.nan)[None])
    q = floats("prior_xyzw", prior_xyzw, 4, default=np.nan)
    if prior_xyzw is not None:
        unit_quaternion("prior_xyzw", q)
    state |= unstack("q{}", q[None], "xyzw")
    known = prior_sigma_arcsec is not None
    prior_sigma = sigma("prior_sigma_arcsec", prior_sigma_arcsec) if known else 0.0
    state["attitude_sigma_arcsec"] = np.array([prior_sigma or np.nan])
    states = _one_row(
        SENSOR_STATES_AT_FRAMES, at_ns, **{name: nullable(v) for name, v in state.items()}
    )
    covariance = unstack_covariance("cov_{}", np.zeros((1, 9, 9)), OPTICS_AXES)
    columns = {name: [value] for name, value in optics("camera", camera)._asdict().items()}
    cameras = _one_row(CAMERAS, at_ns, **columns, **covariance)
    settings = settings or Settings()
    catalogue = read_star_catalogue(settings.identification.catalogue)
    made = identify_stars(
        exposures, states, cameras, catalogue, settings.sensors, settings.identification,
        settings.tracklets.max_detections,
    )  # fmt: skip
    star_id = np.full(n, -1, np.int64)
    star_id[array(made.stars, "centroid")] = array(made.stars, "star_id")
    row = made.solutions
    cov = stack_covariance(row, "cov_att_{}_arcsec2")[0]
    if velocity_km_s is None:  # its error is in the sigmas alone: frames may share it
        np.fill_diagonal(cov, stack(row, "sigma_{}_arcsec")[0] ** 2)
    return IdentifiedFrame(
        star_id,
        stack(row, "q{}", "xyzw")[0],
        cov,
        row["attitude_source"][0].as_py(),
        row["status"][0].as_py(),
        float(array(row, "residual_px")[0]),
    )


def _one_row(schema: pa.Schema, at_ns: int, **values: Any) -> pa.Table:
    """Return a table of one row; what is not given is unknown."""
    key = {"sensor_id": ["frame"], "frame_number": [0], "time": [at_ns]}
    rest = {"exposure_s": [0.0], "source": [""]}
    row = {name: [None] for name in schema.names} | key | rest | values
    return table(schema, {name: row[name] for name in schema.names})


def view_frame(
    x_px: npt.ArrayLike,
    y_px: npt.ArrayLike,
    *,
    camera: Camera,
    attitude_xyzw: npt.ArrayLike,
    position_km: npt.ArrayLike,
    velocity_km_s: npt.ArrayLike,
    sigma_px: npt.ArrayLike,
    attitude_cov_arcsec2: npt.ArrayLike | None = None,
    position_sigma_km: float = 0.05,
) -> View:
    """Return the directions of detections, as `associate` and `triangulate` need them.

    Parameters
    ----------
    x_px, y_px : (n,) float
        Pixel positions of the detections [px].
    camera : Camera
        The sensor's optics.
    attitude_xyzw : (4,) float
        Attitude, sensor from ICRS, as `identify_frame` returns it.
    position_km, velocity_km_s : (3,) float
        Of the sensor, GCRF. The aberration by this velocity is removed from the directions.
    sigma_px : float or (n,) float
        1-sigma errors of the centroids per axis [px].
    attitude_cov_arcsec2 : (3, 3) float, optional
        Covariance of the attitude about the sensor's axes. None: it has no error.
    position_sigma_km : float
        1-sigma error of the sensor's position, per axis.

    Returns
    -------
    View
        With the sensor's position, attitude and camera.

    Raises
    ------
    ValueError
        Where a shape is wrong, a log with this camera would be refused, the attitude is not of
        length 1, as where it is unknown, position or velocity are not known or may be in metres,
        or `sigma_px` or `position_sigma_km` are not numbers from 0 on.

    Examples
    --------
    >>> from epipole.flows import api
    >>> camera = api.Camera(512, 512, 14666.0, 14666.0, 255.5, 255.5)
    >>> view = api.view_frame(
    ...     [255.5], [255.5], camera=camera, attitude_xyzw=[0, 0, 0, 1], sigma_px=0.15,
    ...     position_km=[7000.0, 0.0, 0.0], velocity_km_s=[0.0, 0.0, 0.0],
    ... )
    >>> view.u_icrs.tolist()
    [[0.0, 0.0, 1.0]]
    """
    x = floats("x_px", x_px, "n")
    n = len(x)
    camera = optics("camera", camera)
    u = unproject(camera, x, floats("y_px", y_px, n))
    errors_px = floats("sigma_px", sigma_px, n, repeat=True)
    if not (errors_px >= 0.0).all():
        raise ValueError("sigma_px: has values that are below 0, or no numbers")
    sigma_rad = errors_px * pixel_angle(camera, u)
    attitude = unit_quaternion("attitude_xyzw", floats("attitude_xyzw", attitude_xyzw, 4))
    R = matrix_from_quaternion(attitude[None])[0]
    apparent = u @ R
    error = floats("attitude_cov_arcsec2", attitude_cov_arcsec2, 3, 3, default=0.0)
    cov = centroid_covariance(apparent, sigma_rad)
    cov = cov + attitude_covariance(apparent, R.T @ error @ R * ARCSEC**2)
    u_icrs = aberrate(apparent, -velocity(velocity_km_s))
    return View(
        u_icrs,
        on_tangent_plane(u_icrs, cov),
        position("position_km", position_km),
        sigma("position_sigma_km", position_sigma_km),
        attitude,
        camera,
    )

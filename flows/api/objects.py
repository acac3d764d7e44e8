"""Objects: which directions of several sensors are one object, and where it is."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.flows.api.arguments import (
    floats,
    integers,
    optics,
    position,
    sigma,
    unit_quaternion,
)
from epipole.schemas.arrays import Array, Flags, Indices
from epipole.schemas.settings import Settings
from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.geometry import triangulation
from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.algorithms.geometry.directions import matrix_from_quaternion
from epipole.tasks.solve.associate_objects import associate_by_likelihood

# [rad^2] added to variances of directions: 2e-7 arcsec. Lines without any error have no weights.
LEAST_VARIANCE = 1e-24
SPARSE = 100  # rows of a result per direction: with more, objects are not numbered from 0 on


class View(NamedTuple):
    """What one sensor sees at one instant: n directions.

    `view_frame` makes it from pixel positions. It may be made by hand as well; `triangulate` then
    needs the first three only.

    Attributes
    ----------
    u_icrs : (n, 3) float
        Unit vectors to the objects, ICRS, without the sensor's geocentric aberration.
    cov_rad2 : (n, 2, 2) float
        Their covariances [rad^2], on two axes at right angles to each direction; one (2, 2)
        serves all. Of an isotropic error it is ``sigma_rad**2 * numpy.eye(2)``. The axes are
        those of `epipole.tasks.algorithms.geometry.directions.tangent_basis`.
    position_km : (3,) float
        The sensor's position, GCRF.
    position_sigma_km : float
        Its 1-sigma error, per axis.
    attitude_xyzw : (4,) float or None
        Attitude, sensor from ICRS.
    camera : Camera or None
        The sensor's optics.
    """

    u_icrs: Array
    cov_rad2: Array
    position_km: Array
    position_sigma_km: float = 0.05
    attitude_xyzw: Array | None = None
    camera: Camera | None = None


class FoundObjects(NamedTuple):
    """Which directions are one object.

    Attributes
    ----------
    objects : list of (n,) int
        For each view, the object of each direction: 0, 1, ...; -1 if unknown.
    log_odds : (g,) float
        Of each object, against its directions being unrelated (ln).
    ambiguous : list of (n,) bool
        For each view: whether two objects explain the direction about equally well. It then
        belongs to none.
    """

    objects: list[Indices]
    log_odds: Array
    ambiguous: list[Flags]


class Positions(NamedTuple):
    """Where g objects are.

    Attributes
    ----------
    r_gcrf_km : (g, 3) float
        Positions [km], GCRF; NaN where fewer than two lines are left, or they are parallel within
        their errors or meet behind a sensor.
    cov_km2 : (g, 3, 3) float
        Their covariances.
    chi2 : (g,) float
        Weighted sums of squares; 2 n - 3 degrees of freedom for n lines that were used.
    used : list of (n,) bool
        For each view, which directions were used; false where a residual is too large.
    """

    r_gcrf_km: Array
    cov_km2: Array
    chi2: Array
    used: list[Flags]


def associate(views: Sequence[View], settings: Settings | None = None) -> FoundObjects:
    """Return which directions of several sensors at one instant are one object.

    Parameters
    ----------
    views : sequence of View
        One view per sensor, all of the same instant, each with attitude and camera: the fields
        of view decide who should have seen an object.
    settings : epipole.schemas.settings.Settings, optional
        Those of a run; its group `association` counts.

    Returns
    -------
    FoundObjects

    Raises
    ------
    ValueError
        Where a shape is wrong, a sigma is below 0, a covariance is not one, a position is not known
        or may be in metres, or a view has no attitude of length 1 or no camera.

    Notes
    -----
    A run sums the evidence of many instants. One instant says less: of two sensors, two objects
    in one epipolar plane cannot be distinguished and are ambiguous. Light time is ignored, which is
    right for sensors at similar ranges.

    Examples
    --------
    Three sensors see two objects, in a different order:

    >>> import numpy as np
    >>> from epipole.flows import api
    >>> objects_km = np.array([[42164.0, 0.0, 0.0], [42150.0, 300.0, 100.0]])
    >>> camera = api.Camera(512, 512, 14666.0, 14666.0, 255.5, 255.5)
    >>> looks_along_x = [0.5, 0.5, 0.5, 0.5]  # the boresight is the x axis of the ICRS
    >>> sensors_km = np.array([[7000.0, 0, 0], [0, 7000.0, 0], [0, 0, 7000.0]])
    >>> views = []
    >>> for sensor_km, order in zip(sensors_km, ([0, 1], [1, 0], [0, 1])):
    ...     line = objects_km[order] - sensor_km
    ...     u = line / np.linalg.norm(line, axis=1, keepdims=True)
    ...     cov = (1 / 206265) ** 2 * np.eye(2)  # 1 arcsec
    ...     views.append(api.View(u, cov, sensor_km, 0.01, looks_along_x, camera))
    >>> found = api.associate(views)
    >>> [view.tolist() for view in found.objects]
    [[0, 1], [1, 0], [0, 1]]
    """
    checked = [_checked(k, view) for k, view in enumerate(views)]
    for k, view in enumerate(checked):
        if view.attitude_xyzw is None or view.camera is None:
            raise ValueError(f"views[{k}]: has no attitude or no camera; `associate` needs both")
    counts = [len(view.u_icrs) for view in checked]
    n, s = sum(counts), len(checked)
    cameras = [view.camera for view in checked if view.camera is not None]
    attitude = np.reshape([view.attitude_xyzw for view in checked], (s, 4))
    samples = Samples(
        sensor=np.repeat(np.arange(s), counts),
        start_s=np.zeros(n),
        end_s=np.zeros(n),
        seen=np.ones((n, 1), bool),
        u=_joined([view.u_icrs for view in checked], 3)[:, None],
        cov=_joined([view.cov_rad2 for view in checked], 2, 2)[:, None],
        sigma_km=np.repeat([view.position_sigma_km for view in checked], counts)[:, None],
        time_s=np.zeros(1),
        sensor_km=np.reshape([view.position_km for view in checked], (s, 1, 3)),
        R_sensor_from_icrs=matrix_from_quaternion(attitude)[:, None],
        half_field=np.reshape([c.half_field for c in cameras], (s, 2)),
    )
    focal_px = np.array([c.fx_px for c in cameras], float)
    groups = associate_by_likelihood(samples, focal_px, (settings or Settings()).association)
    return FoundObjects(
        _by_view(groups.group, counts), groups.score, _by_view(groups.ambiguous, counts)
    )


def triangulate(
    views: Sequence[View],
    objects: Sequence[npt.ArrayLike] | None = None,
    *,
    velocity_km_s: npt.ArrayLike | None = None,
    reject_sigma: float | None = None,
) -> Positions:
    """Return the positions of objects from their sight lines, with covariances.

    Parameters
    ----------
    views : sequence of View
        One view per sensor, all of the same instant.
    objects : sequence of (n,) int, optional
        For each view, the object of each direction, as `associate` returns them, numbered from 0
        on; -1: none. None: every view has one direction, and all show one object.
    velocity_km_s : (g, 3) float, optional
        Velocity of each object, GCRF: light to a farther sensor left earlier. None: 0, which is
        right for sensors at similar ranges.
    reject_sigma : float, optional
        Of three or more lines, those with a larger residual are left out, the worst first. None:
        that of the settings.

    Returns
    -------
    Positions

    Raises
    ------
    ValueError
        Where a shape is wrong, a sigma is below 0, a covariance is not one, a position is not known
        or may be in metres, `reject_sigma` is not above 0, an attitude is not of length 1, or
        numbers of objects are not whole, or far above their count.

    References
    ----------
    Gauss-Newton on the angular residuals; Hartley and Sturm (1997), Triangulation, CVIU 68(2).

    Examples
    --------
    Two sensors see one object, each with an error of 1 arcsec:

    >>> import numpy as np
    >>> from epipole.flows import api
    >>> there_km = np.array([42164.0, 0.0, 0.0])
    >>> views = []
    >>> for sensor_km in ([0.0, 7000.0, 0.0], [0.0, -7000.0, 0.0]):
    ...     line = there_km - sensor_km
    ...     u = line / np.linalg.norm(line)
    ...     views.append(api.View([u], (1 / 206265) ** 2 * np.eye(2), sensor_km, 0.0))
    >>> found = api.triangulate(views)
    >>> found.r_gcrf_km[0].round(3).tolist()
    [42164.0, 0.0, 0.0]
    >>> np.sqrt(np.diag(found.cov_km2[0])).round(2).tolist()  # 1-sigma along x, y, z [km]
    [0.89, 0.15, 0.15]
    """
    checked = [_checked(k, view) for k, view in enumerate(views)]
    labels = _labels(checked, objects)
    g = int(labels.max(initial=-1)) + 1
    order = np.argsort(labels, kind="stable")
    order = order[labels[order] >= 0]
    counts = [len(view.u_icrs) for view in checked]
    r_km = np.repeat(np.reshape([view.position_km for view in checked], (-1, 3)), counts, axis=0)
    velocity = floats("velocity_km_s", velocity_km_s, g, 3, default=0.0)
    limit = Settings().positions.reject_sigma if reject_sigma is None else reject_sigma
    if not sigma("reject_sigma", limit) > 0.0:
        raise ValueError("reject_sigma: is 0, expected more")
    found = triangulation.triangulate(
        np.searchsorted(labels[order], np.arange(g + 1)),
        r_km[order],
        _joined([view.u_icrs for view in checked], 3)[order],
        _joined([view.cov_rad2 for view in checked], 2, 2)[order],
        np.repeat([view.position_sigma_km for view in checked], counts)[order],
        velocity,
        limit,
    )
    used = np.zeros(len(labels), np.bool_)
    used[order] = found.used
    return Positions(found.r_km, found.cov_km2, found.chi2, _by_view(used, counts))


def _checked(k: int, view: View) -> View:
    """Return a view whose arrays have their full shapes."""
    name = f"views[{k}]."
    u = floats(name + "u_icrs", view.u_icrs, "n", 3)
    if len(u) and not np.allclose(np.linalg.norm(u, axis=1), 1.0, atol=1e-6):
        raise ValueError(f"{name}u_icrs: are no unit vectors")
    attitude = view.attitude_xyzw
    return View(
        u,
        _covariances(name + "cov_rad2", view.cov_rad2, len(u)),
        position(name + "position_km", view.position_km),
        sigma(name + "position_sigma_km", view.position_sigma_km),
        None if attitude is None else _attitude(name + "attitude_xyzw", attitude),
        None if view.camera is None else optics(name + "camera", view.camera),
    )


def _covariances(name: str, values: npt.ArrayLike, n: int) -> Array:
    cov = floats(name, values, n, 2, 2, repeat=True)
    a, b, c = cov[:, 0, 0], cov[:, 0, 1], cov[:, 1, 1]
    slack = 1e-9 * (a + c)  # rounding
    ok = (a >= 0.0) & (c >= 0.0) & (a + c < np.inf) & (np.abs(b - cov[:, 1, 0]) <= slack)
    ok &= a * c - b * b >= -slack * slack
    if not ok.all():
        raise ValueError(f"{name}: {cov[~ok][0].tolist()} is not a covariance")
    return cov + LEAST_VARIANCE * np.eye(2)


def _attitude(name: str, xyzw: npt.ArrayLike) -> Array:
    return unit_quaternion(name, floats(name, xyzw, 4))


def _labels(views: Sequence[View], objects: Sequence[npt.ArrayLike] | None) -> Indices:
    """Return the object of each direction of all views, one after another."""
    if objects is None:
        many = [k for k, view in enumerate(views) if len(view.u_icrs) != 1]
        if many:
            raise ValueError(
                f"views[{many[0]}]: has {len(views[many[0]].u_icrs)} directions; "
                "`objects` has to say which are one object"
            )
        return np.zeros(len(views), np.int64)
    if len(objects) != len(views):
        raise ValueError(f"objects: has {len(objects)} entries, expected {len(views)}, one a view")
    labels = [
        integers(f"objects[{k}]", of, len(view.u_icrs))
        for k, (of, view) in enumerate(zip(objects, views, strict=True))
    ]
    joined = np.concatenate([np.zeros(0, np.int64), *labels])
    largest, n = int(joined.max(initial=-1)), len(joined)
    if largest >= SPARSE * max(n, 100):
        raise ValueError(
            f"objects: has {largest} for {n} directions, and the result has a row per number up "
            "to the largest; number the objects from 0 on (numpy.unique with return_inverse)"
        )
    return joined


def _joined(arrays: Sequence[Array], *shape: int) -> Array:
    return np.concatenate([np.zeros((0, *shape)), *arrays])


def _by_view(values: npt.NDArray[Any], counts: list[int]) -> list[npt.NDArray[Any]]:
    ends = np.cumsum(counts)
    return [values[end - n : end] for n, end in zip(counts, ends, strict=True)]

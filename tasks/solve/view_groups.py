"""Views as arrays: the views of objects, and their groups by epoch and object.

The table VIEWS is unpacked once, when the views of a piece have been gathered. A piece is solved
with these arrays; the results are packed into tables once.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.work_layout import NOTHING_ADDED, AddedErrors
from epipole.schemas.arrays import Array, Flags, Indices
from epipole.schemas.bridge import (
    array,
    stack,
    stack_covariance,
    unstack,
    unstack_covariance,
)
from epipole.schemas.columns import TANGENT_AXES
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import apparent_positions
from epipole.tasks.algorithms.geometry.moved_planes import on_moved_plane
from epipole.tasks.common.grouping import factorize

# Columns of VIEWS that are only passed on.
LABELS = (
    *("epoch", "sensor_id", "frame_number", "tracklet_id", "centroid", "x_px", "y_px"),
    *("attitude_rad2", "turn_noise_rad2", "field_part", "first_fitted", "last_fitted"),
)


class ObjectViews(NamedTuple):
    """Views of objects, a row per view; see VIEWS for the reference frames.

    labels : table
        The columns `LABELS`.
    epoch_ns, object_number : (n,) int
        Epochs [ns since 1970], and the objects.
    sensor, tracklet : (n,) int
        Ranks of the ids.
    sensor_ids : (s,) str
        The ids of the ranks, in order.
    first_ns, last_ns : (n,) int
        First and last detection that the direction was fitted to.
    u, cov_noise, cov_bias : (n, 3), (n, 2, 2), (n, 2, 2) float
        Directions, ICRS, and the covariances on their tangent planes [rad^2].
    w : (n, 3) float
        Rates of the directions [rad/s], ICRS; 0 where unknown.
    moments, unmodelled : (n, 3), (n,) float
        Moments of the fitted times [s, s^2, s^3], and the neglected motion [rad^2].
    r_km, v_km_s, sigma_km : (n, 3), (n, 3), (n,) float
        Positions and velocities of the sensors, GCRF, and 1-sigma of a position per axis.
    pixel_rad : (n,) float
        Angle of a pixel [rad].
    """

    labels: pa.Table
    epoch_ns: Indices
    object_number: Indices
    sensor: Indices
    sensor_ids: npt.NDArray[np.str_]
    tracklet: Indices
    first_ns: Indices
    last_ns: Indices
    u: Array
    cov_noise: Array
    cov_bias: Array
    w: Array
    moments: Array
    unmodelled: Array
    r_km: Array
    v_km_s: Array
    sigma_km: Array
    pixel_rad: Array

    @property
    def cov(self) -> Array:
        """Covariances of the directions, independent and shared errors together [rad^2]."""
        return self.cov_noise + self.cov_bias

    def take(self, rows: Indices) -> "ObjectViews":
        """Return these rows."""
        whole = self._asdict()
        ids = whole.pop("sensor_ids")
        labels = whole.pop("labels").take(rows)
        return ObjectViews(
            labels=labels, sensor_ids=ids, **{name: values[rows] for name, values in whole.items()}
        )


def with_added_errors(views: pa.Table, added: AddedErrors) -> pa.Table:
    """Return VIEWS of one sensor: known biases are taken off, errors are enlarged."""
    if added == NOTHING_ADDED or not views.num_rows:
        return views
    fault = added.of(views["sensor_id"][0].as_py())
    columns = {
        "position_sigma_km": np.hypot(array(views, "position_sigma_km"), fault.left_km),
        **unstack("{}_km", stack(views, "{}_km") - np.array(fault.bias_km)),
    }
    if fault.left_rad:
        u, w = stack(views, "u{}"), stack(views, "w{}_rad_s")
        right = u - np.cross(fault.bias_rad, u)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        columns |= unstack("u{}", right)
        columns |= unstack("w{}_rad_s", w - np.cross(fault.bias_rad, w))
        for part, more in (("noise", 0.0), ("bias", fault.left_rad**2)):
            cov = stack_covariance(views, f"cov_{part}_{{}}_rad2", TANGENT_AXES)
            cov = on_moved_plane(cov, u, right) + more * np.eye(2)
            columns |= unstack_covariance(f"cov_{part}_{{}}_rad2", cov, TANGENT_AXES)
        columns["attitude_rad2"] = array(views, "attitude_rad2") + fault.left_rad**2
    for name, values in columns.items():
        at = views.schema.get_field_index(name)
        views = views.set_column(at, views.schema.field(at), pa.array(values))
    return views


def unpack_views(views: pa.Table, object_number: Indices) -> ObjectViews:
    """Return VIEWS as arrays, each with the number of its object."""
    sensor, sensor_ids = factorize(views, "sensor_id")
    return ObjectViews(
        labels=views.select(LABELS),
        epoch_ns=array(views, "epoch").copy(),
        object_number=object_number,
        sensor=sensor,
        sensor_ids=sensor_ids,
        tracklet=factorize(views, "tracklet_id").rank,
        first_ns=array(views, "first_fitted").copy(),
        last_ns=array(views, "last_fitted").copy(),
        u=stack(views, "u{}"),
        cov_noise=stack_covariance(views, "cov_noise_{}_rad2", TANGENT_AXES),
        cov_bias=stack_covariance(views, "cov_bias_{}_rad2", TANGENT_AXES),
        w=stack(views, "w{}_rad_s"),
        moments=stack(views, "moment_{}", "123"),
        unmodelled=array(views, "unmodelled_rad2").copy(),
        r_km=stack(views, "{}_km"),
        v_km_s=stack(views, "sensor_v{}_km_s"),
        sigma_km=array(views, "position_sigma_km").copy(),
        pixel_rad=array(views, "pixel_rad").copy(),
    )


def with_larger_errors(views: ObjectViews, errors: pa.Table) -> ObjectViews:
    """Return views with the shared errors of some sensors as large as SHARED_ERRORS say."""
    return _scaled(views, errors, 1.0)


def with_stated_errors(
    views: ObjectViews, errors: pa.Table, added: AddedErrors = NOTHING_ADDED
) -> ObjectViews:
    """Return views with the errors of positions that the sensors state.

    This undoes `with_larger_errors`, and what `with_added_errors` adds to errors of positions.
    """
    stated = _scaled(views, errors, -1.0)
    if added == NOTHING_ADDED:
        return stated
    km = np.array([added.of(name).left_km for name in views.sensor_ids.tolist()])[views.sensor]
    return stated._replace(sigma_km=np.sqrt(np.maximum(stated.sigma_km**2 - km**2, 0.0)))


def _scaled(views: ObjectViews, errors: pa.Table, power: float) -> ObjectViews:
    """Return views with their shared variances times a power of the factors in SHARED_ERRORS."""
    if not errors.num_rows:
        return views
    row = pc.index_in(pa.array(views.sensor_ids), errors["sensor_id"].combine_chunks())
    direction, position = (
        pc.fill_null(errors[name].take(row), 1.0).to_numpy()[views.sensor] ** power
        for name in ("direction", "position")
    )
    return views._replace(
        cov_bias=views.cov_bias * direction[:, None, None],
        sigma_km=views.sigma_km * np.sqrt(position),
    )


class ViewGroups(NamedTuple):
    """Views grouped by epoch and object, and the solution of each of the g groups.

    views : ObjectViews
        In the order of the groups. Where an object's motion is known, their directions are
        corrected for the motion that their fits neglected.
    row : (n,) int
        Row of each view in the views that were solved.
    offsets : (g + 1,) int
        Group k has the views ``offsets[k]:offsets[k + 1]``.
    object_id, epoch_ns : (g,) str, (g,) int
        Object and epoch of each group.
    x_km, cov_km2, velocity_km_s : (g, 3), (g, 3, 3), (g, 3) float
        Positions at the epoch minus the mean light time, GCRF; NaN where there is no solution.
    chi2, mean_range_km : (g,) float
        Of the solution; NaN where there is none.
    used : (n,) bool
        The view takes part in the solution.
    independent : (g,) bool
        Groups that may be used together: no two of them share a detection.
    """

    views: ObjectViews
    row: Indices
    offsets: Indices
    object_id: npt.NDArray[np.object_]
    epoch_ns: Indices
    x_km: Array
    cov_km2: Array
    velocity_km_s: Array
    chi2: Array
    mean_range_km: Array
    used: Flags
    independent: Flags

    @property
    def group(self) -> Indices:
        """Group of each view."""
        return np.repeat(np.arange(len(self.epoch_ns)), np.diff(self.offsets))

    @property
    def solved(self) -> Flags:
        """The groups that have a position."""
        return np.isfinite(self.chi2)

    @property
    def n_used(self) -> Indices:
        """Number of views of each group that take part in its solution."""
        count = np.bincount(self.group, self.used, minlength=len(self.epoch_ns))
        return count.astype(np.int64)

    @property
    def apparent_km(self) -> Array:
        """Position at which the sensor of each view sees the object: where its light left."""
        group = self.group
        light_s = self.mean_range_km / SPEED_OF_LIGHT_KM_S
        return apparent_positions(
            self.x_km[group], self.velocity_km_s[group], light_s[group], self.views.r_km
        )

    def within(self, epochs: Flags) -> "ViewGroups":
        """Return the groups with these epochs, (g,) bool."""
        if epochs.all():
            return self
        rows = np.flatnonzero(epochs[self.group])
        size = np.diff(self.offsets)[epochs]
        return ViewGroups(
            views=self.views.take(rows),
            row=self.row[rows],
            offsets=np.concatenate([[0], np.cumsum(size)]).astype(np.int64),
            object_id=self.object_id[epochs],
            epoch_ns=self.epoch_ns[epochs],
            x_km=self.x_km[epochs],
            cov_km2=self.cov_km2[epochs],
            velocity_km_s=self.velocity_km_s[epochs],
            chi2=self.chi2[epochs],
            mean_range_km=self.mean_range_km[epochs],
            used=self.used[rows],
            independent=self.independent[epochs],
        )

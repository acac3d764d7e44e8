"""What the association works on: tracklets, or lone points, of all sensors at common instants."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.sky import ARCSEC, tangent_basis

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Flags = npt.NDArray[np.bool_]

FREE = -1


class Samples(NamedTuple):
    """Tracklets of all sensors at a few common instants: t tracklets, k instants, s sensors.

    sensor : (t,) int
        Whose tracklet it is, 0 .. s - 1.
    start_s, end_s : (t,) float
        First and last detection [s]; tracklets of one sensor that overlap are two objects.
    seen : (t, k) bool
        The tracklet has a direction at the instant.
    u : (t, k, 3) float
        Directions without aberration, ICRS.
    cov : (t, k, 2, 2) float
        Their covariances [rad^2] on `tangent_basis(u)`.
    sigma_km : (t, k) float
        1-sigma errors of the sensor positions an axis.
    time_s : (k,) float
        The instants.
    sensor_km : (s, k, 3) float
        Where the sensors are, GCRF; NaN where unknown, which no tracklet seen then may have.
    R_sensor_from_icrs : (s, k, 3, 3) float
        How the sensors are turned; NaN where unknown.
    half_field : (s, 2) float
        Tangents of half the field's width and height.
    """

    sensor: Indices
    start_s: Array
    end_s: Array
    seen: Flags
    u: Array
    cov: Array
    sigma_km: Array
    time_s: Array
    sensor_km: Array
    R_sensor_from_icrs: Array
    half_field: Array

    @property
    def field_sr(self) -> Array:
        """Solid angle of each sensor's field, (s,)."""
        x, y = self.half_field.T
        return 4 * np.arcsin(np.clip(x * y / np.sqrt((1 + x * x) * (1 + y * y)), 0, 1))


class Groups(NamedTuple):
    """Which tracklets are one object.

    group : (t,) int
        Group of each tracklet; -1 where it belongs to none.
    score : (g,) float
        Log of the odds of each group against its members being unrelated.
    ambiguous : (t,) bool
        Tracklets left out because two groups claim them about equally well, or because one
        does without being sure enough.
    """

    group: Indices
    score: Array
    ambiguous: Flags


class Views(NamedTuple):
    """`Samples` by sensor, with what the compiled search looks up again and again.

    Tracklets of sensor s are ``first[s]:first[s + 1]``. Around the middle of each sensor's
    directions at each instant they are sorted into the cells of a grid in the gnomonic plane:
    the cells of sensor s at instant m begin at ``grid[s, m, 0]`` of `cell_start`, and there are
    ``grid[s, m, 1]`` a side.
    """

    first: Indices
    sensor: Indices
    start_s: Array
    end_s: Array
    seen: Flags
    u: Array
    basis: Array
    cov: Array
    spot: Array
    sigma_km: Array
    time_s: Array
    r_km: Array
    attitude: Array
    half_field: Array
    plane: Array
    grid: Indices
    corner: Array
    cells_per_unit: Array
    widest: Array
    cell_start: Indices
    cell_item: Indices


def views_of(samples: Samples) -> tuple[Views, Indices]:
    """Return the samples sorted by sensor, ready to be searched, and the order that did it."""
    n_sensors, n_instants = samples.sensor_km.shape[:2]
    order = np.argsort(samples.sensor, kind="stable")
    sensor = samples.sensor[order]
    u, cov, seen = samples.u[order], samples.cov[order], samples.seen[order]
    first = np.searchsorted(sensor, np.arange(n_sensors + 1))
    # The larger eigenvalue of a 2x2 covariance, for gates that must not be too narrow.
    half = (cov[..., 0, 0] + cov[..., 1, 1]) / 2
    apart = np.hypot((cov[..., 0, 0] - cov[..., 1, 1]) / 2, cov[..., 0, 1])
    largest = half + apart
    plane = np.zeros((n_sensors, n_instants, 3, 3))
    grid = np.zeros((n_sensors, n_instants, 2), np.int64)
    corner, scale = np.zeros((n_sensors, n_instants, 2)), np.zeros((n_sensors, n_instants, 2))
    widest = np.zeros((n_sensors, n_instants))
    starts: list[Indices] = []
    items: list[Indices] = []
    begin = 0
    for s in range(n_sensors):
        for m in range(n_instants):
            own = first[s] + np.flatnonzero(seen[first[s] : first[s + 1], m])
            grid[s, m, 0] = begin
            if not len(own):
                continue
            centre = u[own, m].sum(axis=0)
            plane[s, m, 2] = centre / np.linalg.norm(centre)
            plane[s, m, :2] = tangent_basis(plane[s, m, 2])
            widest[s, m] = largest[own, m].max()
            side, corner[s, m], scale[s, m], cell = _cells(u[own, m] @ plane[s, m].T)
            by_cell = np.argsort(cell, kind="stable")
            count = np.bincount(cell, minlength=side * side)
            starts.append(
                sum(len(cells) for cells in items) + np.concatenate([[0], np.cumsum(count)])
            )
            items.append(own[by_cell])
            grid[s, m, 1] = side
            begin += side * side + 1
    views = Views(
        first=first.astype(np.int64),
        sensor=sensor.astype(np.int64),
        start_s=samples.start_s[order].astype(float),
        end_s=samples.end_s[order].astype(float),
        seen=np.ascontiguousarray(seen),
        u=np.ascontiguousarray(u, float),
        basis=np.ascontiguousarray(tangent_basis(u)),
        cov=np.ascontiguousarray(cov, float),
        spot=2 * np.pi * np.sqrt(np.maximum(half**2 - apart**2, 0.0)),
        sigma_km=np.ascontiguousarray(samples.sigma_km[order], float),
        time_s=samples.time_s.astype(float),
        r_km=np.ascontiguousarray(samples.sensor_km, float),
        attitude=np.ascontiguousarray(samples.R_sensor_from_icrs, float),
        half_field=np.ascontiguousarray(samples.half_field, float),
        plane=plane,
        grid=grid,
        corner=corner,
        cells_per_unit=scale,
        widest=widest,
        cell_start=np.concatenate([*starts, np.zeros(1, np.int64)]).astype(np.int64),
        cell_item=np.concatenate([*items, np.zeros(0, np.int64)]).astype(np.int64),
    )
    return views, order


def _cells(toward: Array) -> tuple[int, Array, Array, Indices]:
    """Return a square grid of about one point a cell, and the cell of each point.

    `toward` are directions along the plane's two axes and its normal.
    """
    place = toward[:, :2] / np.maximum(toward[:, 2:], 1e-3)
    low, high = place.min(axis=0), place.max(axis=0)
    side = max(int(np.sqrt(len(place))), 1)
    scale = side / np.maximum(high - low, 1e-9) * (1 - 1e-9)
    row = np.minimum(((place - low) * scale).astype(np.int64), side - 1)
    return side, low, scale, row[:, 0] * side + row[:, 1]


class Chance(NamedTuple):
    """What chance has to work with, estimated from the data.

    density : (s,) float
        Tracklets a steradian.
    drift : (s, 3) float
        How its tracklets move, the median rate of their directions [1/s].
    spread : (s,) float
        How differently the tracklets of a sensor move, 1-sigma an axis [rad/s].
    objects_in_view, objects_km3 : float
        How many objects there are, at most, and that a km^3 of the space in view.
    detected : float
        Probability that a sensor which looks at an object has a tracklet of it.
    """

    density: Array
    drift: Array
    spread: Array
    objects_in_view: float
    objects_km3: float
    detected: float


def chance_of(samples: Samples, farthest_km: float, detected: float) -> Chance:
    """Return what chance has to work with before anything is associated."""
    n_sensors = len(samples.field_sr)
    count = np.bincount(samples.sensor, minlength=n_sensors).astype(float)
    instants = np.maximum(samples.seen.any(axis=0).sum(), 1)
    # A tracklet that is seen at one instant of many is not in the field at the others.
    share = np.bincount(samples.sensor, samples.seen.sum(axis=1), minlength=n_sensors) / instants
    density = np.maximum(share, 1.0) / samples.field_sr
    rate = _rates(samples)
    drift, spread = np.zeros((n_sensors, 3)), np.empty(n_sensors)
    for s in range(n_sensors):
        own = rate[(samples.sensor == s) & np.isfinite(rate[:, 0])]
        # One made-up tracklet at 10 arcsec/s keeps the estimate sane where there are few.
        drift[s] = np.median(own, axis=0) if len(own) else 0.0
        squares = np.sum((own - drift[s]) ** 2) / 2
        spread[s] = np.sqrt((squares + (10 * ARCSEC) ** 2) / (len(own) + 1))
    volume = float(np.median(samples.field_sr)) * farthest_km**3 / 3
    objects = max(float(np.median(count)), 1.0)
    return Chance(density, drift, spread, objects, objects / volume, detected)


def _rates(samples: Samples) -> Array:
    """Return each tracklet's mean rate [rad/s] between its first and last sample; NaN: one."""
    out = np.full((len(samples.sensor), 3), np.nan)
    n_instants = samples.seen.shape[1]
    twice = np.flatnonzero(samples.seen.sum(axis=1) > 1)
    if len(twice):
        a = np.argmax(samples.seen[twice], axis=1)
        b = n_instants - 1 - np.argmax(samples.seen[twice, ::-1], axis=1)
        dt = samples.time_s[b] - samples.time_s[a]
        out[twice] = (samples.u[twice, b] - samples.u[twice, a]) / dt[:, None]
    return out

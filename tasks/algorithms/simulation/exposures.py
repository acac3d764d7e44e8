"""Exposures: all centroids of a sensor in a block of frames, and the source of each."""

from dataclasses import dataclass
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from epipole.tasks.algorithms.simulation.element_sets import (
    directions_to_sun,
    earth_at,
    julian_years_since,
)
from epipole.tasks.algorithms.simulation.optics import (
    boost,
    field_radius,
    hidden_by_earth,
    image_position,
    on_image,
    received_from,
)
from epipole.tasks.algorithms.simulation.sensor import (
    Attitudes,
    SimulatedSensor,
    boresight_hidden,
    random_stream,
    seconds_since,
)
from epipole.tasks.algorithms.simulation.sources import (
    SimulatedObjects,
    StarField,
    detection_probability,
    star_directions,
    stars_in_cones,
)

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

STAR, TARGET, FALSE = 0, 1, 2
MERGE_PX = 2.0  # stars closer than this are one spot
FLUX_AT_ZERO = 1e6  # of magnitude 0, arbitrary units
ABERRATION_ROOM = 1.5e-3  # [rad] aberration is 1.3e-4, proper motion in 30 years at most 1.5e-3
SATELLITE_RADIUS_KM = 0.1  # nearer is the satellite that carries the sensor, or is docked to it
TARGETS_AT_ONCE = 500_000  # pairs of a frame and a target, to bound the memory


@dataclass
class TrueSpots:
    """True spots of a block of frames, one entry each; `frame` is an index in the block."""

    frame: Indices
    x_px: Array
    y_px: Array
    magnitude: Array
    kind: npt.NDArray[np.int8]
    source: Indices


@dataclass
class Exposures:
    """A block of frames: true states, and the centroids of all frames with their sources.

    Frame i has the centroids ``offsets[i]:offsets[i + 1]``. Attitudes are sensor from ICRS.
    """

    frame_number: Indices
    time_ns: Indices
    r_km: Array
    v_km_s: Array
    attitude: Rotation
    offsets: Indices
    x_px: Array
    y_px: Array
    flux: Array
    sigma_px: Array
    kind: npt.NDArray[np.int8]
    source: Indices
    magnitude: Array  # without noise


class Exposing:
    """Makes the exposures of a sensor, from its frames in order of time in blocks of any length."""

    def __init__(
        self, sensor: SimulatedSensor, stars: StarField, objects: SimulatedObjects
    ) -> None:
        self.sensor, self.stars, self.objects = sensor, stars, objects
        self.attitudes = Attitudes(sensor)
        self._radius = field_radius(sensor.optics)
        purposes = (
            "jitter", "star drop", "target drop", "target fade", "false count", "false place",
            "false light", "centroid noise", "flux noise", "shuffle",
        )  # fmt: skip
        self._streams = {p: random_stream(sensor.seed, sensor.index, p) for p in purposes}
        self._hot = self._hot_pixels()
        self._neighbours = self._close_stars()

    def expose(self, frame_number: Indices, time_ns: Indices) -> Exposures:
        """Return the exposures of these frames, without those that the sensor skips."""
        s = self.sensor
        r_km, v_km_s = s.path.at(seconds_since(s.t0_ns, time_ns))
        attitude = self.attitudes.at(time_ns, r_km, v_km_s)
        jitter = self._streams["jitter"].standard_normal((len(time_ns), 3)) * s.jitter
        attitude = Rotation.from_rotvec(jitter) * attitude if len(time_ns) else attitude
        if s.skip_hidden and len(time_ns):
            free = ~boresight_hidden(r_km, attitude)
            frame_number, time_ns = frame_number[free], time_ns[free]
            r_km, v_km_s, attitude = r_km[free], v_km_s[free], attitude[free]
        if not len(time_ns):
            return _nothing(frame_number, time_ns, r_km, v_km_s, attitude)
        R_sensor_from_icrs = attitude.as_matrix()
        earth_km, earth_km_s = earth_at(time_ns)
        spots = [
            self._star_spots(time_ns, r_km, earth_km, earth_km_s + v_km_s, R_sensor_from_icrs),
            self._target_spots(time_ns, r_km, v_km_s, earth_km_s, R_sensor_from_icrs),
            self._false_spots(len(time_ns)),
        ]
        return self._measure(_joined(spots), frame_number, time_ns, r_km, v_km_s, attitude)

    def _star_spots(
        self, time_ns: Indices, r_km: Array, earth_km: Array, v_km_s: Array, R: Array
    ) -> TrueSpots:
        s, field = self.sensor, self.stars
        frame, star = stars_in_cones(field, R[:, 2], self._radius + ABERRATION_ROOM)
        years = julian_years_since(field.epoch, time_ns)
        u = star_directions(field, star, years[frame], (earth_km + r_km)[frame])
        clear = ~hidden_by_earth(r_km[frame], u, np.inf)
        frame, star, u = frame[clear], star[clear], u[clear]
        x, y, ok = self._image(boost(u, v_km_s[frame]), R[frame])
        frame, star, x, y = frame[ok], star[ok], x[ok], y[ok]
        spots = self._merged(frame, star, x, y)
        inside = on_image(s.optics, spots.x_px, spots.y_px)
        kept = self._streams["star drop"].random(int(inside.sum())) >= s.star_drop
        return _selected(spots, np.flatnonzero(inside)[kept])

    def _target_spots(
        self, time_ns: Indices, r_km: Array, v_km_s: Array, earth_km_s: Array, R: Array
    ) -> TrueSpots:
        s, objects = self.sensor, self.objects
        t_s = seconds_since(s.t0_ns, time_ns)
        u_to_sun = directions_to_sun(time_ns) if objects.need_sun else np.empty((len(t_s), 3))
        parts = []
        step = max(TARGETS_AT_ONCE // max(len(objects), 1), 1)
        for low in range(0, len(time_ns) if len(objects) else 0, step):
            frame, target = self._in_cone(t_s, r_km, R, low, min(low + step, len(t_s)))
            states_at = partial(objects.paths.at, body=target)
            d, r_sent = received_from(states_at, t_s[frame], r_km[frame], earth_km_s[frame])
            distance = np.linalg.norm(d, axis=1)
            u = d / distance[:, None]
            ok = ~hidden_by_earth(r_km[frame], u, distance)
            x, y, inside = self._image(boost(u, (earth_km_s + v_km_s)[frame]), R[frame])
            ok &= inside & on_image(s.optics, x, y)
            magnitude = objects.magnitudes(target, d, r_sent, u_to_sun[frame])
            parts.append((frame[ok], target[ok], x[ok], y[ok], magnitude[ok]))
        frame, target, x, y, magnitude = (
            np.concatenate([np.empty(0, k), *[p[i] for p in parts]])
            for i, k in enumerate((np.int64, np.int64, float, float, float))
        )
        kind = np.full(len(frame), TARGET, np.int8)
        return self._detected(TrueSpots(frame, x, y, magnitude, kind, target))

    def _in_cone(
        self, t_s: Array, r_km: Array, R: Array, low: int, high: int
    ) -> tuple[Indices, Indices]:
        """Return the pairs of a frame (from low to high) and an object about its field."""
        of_frame, of_target = np.arange(low, high), np.arange(len(self.objects))
        frame, target = (v.ravel() for v in np.meshgrid(of_frame, of_target, indexing="ij"))
        d = self.objects.paths.at(t_s[frame], target)[0] - r_km[frame]
        along = np.einsum("ij,ij->i", d, R[frame, 2])
        distance_km = np.linalg.norm(d, axis=1)
        # In the light time d changes by less than 2e-4 of itself.
        near = along >= distance_km * np.cos(self._radius + ABERRATION_ROOM)
        near &= distance_km > SATELLITE_RADIUS_KM
        return frame[near], target[near]

    def _detected(self, spots: TrueSpots) -> TrueSpots:
        """Return the spots of objects that are bright enough and not missed."""
        s = self.sensor
        chance = detection_probability(spots.magnitude, s.object_limit, s.fade)
        draw = self._streams["target fade"].random(len(chance))
        bright = draw < chance  # a sharp limit has chances of 0 and 1
        spots = _selected(spots, np.flatnonzero(bright))
        kept = self._streams["target drop"].random(len(spots.frame)) >= s.target_drop
        return _selected(spots, np.flatnonzero(kept))

    def _false_spots(self, n_frames: int) -> TrueSpots:
        s, streams = self.sensor, self._streams
        n = streams["false count"].poisson(s.false_points, n_frames)
        x_y = streams["false place"].random((int(n.sum()), 2))
        magnitude = _random_magnitudes(streams["false light"], len(x_y), s.magnitude_limit)
        hot, hot_magnitude = self._hot
        frame = np.arange(n_frames)
        frame = np.concatenate([np.repeat(frame, n), np.repeat(frame, len(hot))])
        size = np.array([s.optics.width, s.optics.height])
        x_y = np.concatenate([x_y * size - 0.5, np.tile(hot, (n_frames, 1))])
        magnitude = np.concatenate([magnitude, np.tile(hot_magnitude, n_frames)])
        kind = np.full(len(frame), FALSE, np.int8)
        return TrueSpots(frame, x_y[:, 0], x_y[:, 1], magnitude, kind, np.full(len(frame), -1))

    def _image(self, u: Array, R: Array) -> tuple[Array, Array, npt.NDArray[np.bool_]]:
        """Return columns and rows [px], and which directions are within the camera's cone."""
        in_sensor = np.einsum("nij,nj->ni", R, u)
        ok = in_sensor[:, 2] > np.cos(self._radius)
        x, y = np.full(len(u), np.nan), np.full(len(u), np.nan)
        x[ok], y[ok] = image_position(self.sensor.optics, in_sensor[ok])
        return x, y, ok

    def _close_stars(self) -> tuple[Indices, Indices]:
        """Return the pairs of stars that may be within MERGE_PX of each other."""
        # A lens stretches by a few per cent at most, proper motion by some arcseconds.
        optics = self.sensor.optics
        radius = 1.2 * MERGE_PX / min(optics.fx_px, optics.fy_px) + 3e-4
        pairs = cKDTree(self.stars.u_icrs).query_pairs(radius, output_type="ndarray")
        pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
        return pairs[:, 0], pairs[:, 1]

    def _merged(self, frame: Indices, star: Indices, x: Array, y: Array) -> TrueSpots:
        """Return star spots; stars within MERGE_PX are one, with the number of the brightest."""
        n_stars = len(self.stars.star_id)
        key = frame * n_stars + star
        order = np.argsort(key, kind="stable")
        frame, star, x, y, key = frame[order], star[order], x[order], y[order], key[order]
        first, second = self._neighbours
        low, high = np.searchsorted(first, star), np.searchsorted(first, star, side="right")
        n = high - low
        a = np.repeat(np.arange(len(star)), n)
        other = second[np.arange(n.sum()) - np.repeat(np.cumsum(n) - n, n) + np.repeat(low, n)]
        b = np.searchsorted(key, frame[a] * n_stars + other)
        there = (b < len(key)) & (key[np.minimum(b, len(key) - 1)] == frame[a] * n_stars + other)
        a, b = a[there], b[there]
        close = np.hypot(x[a] - x[b], y[a] - y[b]) < MERGE_PX
        links = coo_matrix((np.ones(close.sum()), (a[close], b[close])), shape=(len(key),) * 2)
        n_spots, spot = connected_components(links, directed=False)
        light = 10 ** (-0.4 * self.stars.magnitude[star])
        total = np.bincount(spot, light, n_spots)
        # The brightest of each spot comes first in this order.
        order = np.lexsort((-light, spot))
        brightest = order[np.searchsorted(spot[order], np.arange(n_spots))]
        return TrueSpots(
            frame[brightest],
            np.bincount(spot, light * x, n_spots) / total,
            np.bincount(spot, light * y, n_spots) / total,
            -2.5 * np.log10(total),
            np.full(n_spots, STAR, np.int8),
            self.stars.star_id[star[brightest]],
        )

    def _hot_pixels(self) -> tuple[Array, Array]:
        s = self.sensor
        rng = random_stream(s.seed, s.index, "hot pixels")
        x_y = rng.integers(0, [s.optics.width, s.optics.height], (s.hot_pixels, 2))
        return x_y.astype(float), _random_magnitudes(rng, s.hot_pixels, s.magnitude_limit)

    def _measure(
        self,
        spots: TrueSpots,
        frame_number: Indices,
        time_ns: Indices,
        r_km: Array,
        v_km_s: Array,
        attitude: Rotation,
    ) -> Exposures:
        """Return the exposures with noise on their centroids, in random order in each frame."""
        s = self.sensor
        limit = np.where(spots.kind == TARGET, s.object_limit, s.magnitude_limit)
        brightness = 10 ** (0.4 * (spots.magnitude - limit))  # 1 at the limit
        sigma = np.hypot(s.sigma_px, s.faint_sigma_px * brightness)
        # Sorted by frame, so that the noise does not depend on the length of the blocks.
        order = np.lexsort((np.arange(len(spots.frame)), spots.frame))
        noise = self._streams["centroid noise"].standard_normal((len(order), 2))
        light = self._streams["flux noise"].standard_normal(len(order))
        shuffle = self._streams["shuffle"].random(len(order))
        x = spots.x_px[order] + noise[:, 0] * sigma[order]
        y = spots.y_px[order] + noise[:, 1] * sigma[order]
        flux = FLUX_AT_ZERO * 10 ** (-0.4 * spots.magnitude[order])
        flux = flux * np.maximum(1 + s.flux_error * light, 0.01)
        # Noise may carry a spot over the edge: there is no pixel to see it.
        inside = np.flatnonzero(on_image(s.optics, x, y))
        mixed = inside[np.lexsort((shuffle[inside], spots.frame[order][inside]))]
        n = np.bincount(spots.frame[order][mixed], minlength=len(time_ns))
        return Exposures(
            frame_number,
            time_ns,
            r_km,
            v_km_s,
            attitude,
            np.concatenate([[0], np.cumsum(n)]),
            x[mixed],
            y[mixed],
            flux[mixed],
            sigma[order][mixed],
            spots.kind[order][mixed],
            spots.source[order][mixed],
            spots.magnitude[order][mixed],
        )


def _random_magnitudes(rng: np.random.Generator, n: int, limit: float) -> Array:
    """Return magnitudes spread as the sky's: star counts rise by 10^0.5 a magnitude."""
    return limit + 2 * np.log10(1 - rng.random(n))


def _selected(spots: TrueSpots, at: Indices) -> TrueSpots:
    return TrueSpots(
        spots.frame[at],
        spots.x_px[at],
        spots.y_px[at],
        spots.magnitude[at],
        spots.kind[at],
        spots.source[at],
    )


def _joined(parts: list[TrueSpots]) -> TrueSpots:
    names = ("frame", "x_px", "y_px", "magnitude", "kind", "source")
    return TrueSpots(*[np.concatenate([getattr(p, name) for p in parts]) for name in names])


def _nothing(
    frame_number: Indices, time_ns: Indices, r_km: Array, v_km_s: Array, attitude: Rotation
) -> Exposures:
    none, whole = np.empty(0), np.empty(0, np.int64)
    return Exposures(
        frame_number, time_ns, r_km, v_km_s, attitude, np.zeros(1, np.int64),
        none, none, none, none, np.empty(0, np.int8), whole, none,
    )  # fmt: skip

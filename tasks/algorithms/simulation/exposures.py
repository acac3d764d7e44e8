"""Exposures: all centroids of a sensor in a block of frames, and the source of each."""

from collections.abc import Iterator
from dataclasses import dataclass, fields
from functools import partial

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from epipole.schemas.arrays import Array, Flags, Indices
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

STAR, TARGET, FALSE = 0, 1, 2
MERGE_PX = 2.0  # stars closer than this are one spot
FLUX_AT_ZERO = 1e6  # of magnitude 0, arbitrary units
BLEND_DEPTH = 1.5  # [mag] fainter than the limit by more: does not count in a blend
ABERRATION_ROOM = 1.5e-3  # [rad] aberration is 1.3e-4, proper motion in 30 years at most 1.5e-3
SATELLITE_RADIUS_KM = 0.1  # nearer is the satellite that carries the sensor, or is docked to it
TARGETS_AT_ONCE = 500_000  # pairs of a frame and a target, to bound the memory
SEGMENT_S = 4.0  # frames for which candidates about the field are chosen at once
ROW_ROUNDS = 4  # each leaves 2 % of the error at 1,000 px/s and 20 us from row to row
MAX_SPEED_KM_S = 12.0  # of an object on a closed orbit: escape velocity at the ground is 11.2


@dataclass
class TrueSpots:
    """True spots of a block of frames, one entry each; `frame` is an index in the block."""

    frame: Indices
    x_px: Array
    y_px: Array
    magnitude: Array
    kind: npt.NDArray[np.int8]
    source: Indices
    also: Indices  # an object that is blended into the spot; -1 without one
    trail_x_px: Array  # from the start of the exposure to its end
    trail_y_px: Array


def true_spots(
    frame: Indices, x_px: Array, y_px: Array, magnitude: Array, kind: int, source: Indices
) -> TrueSpots:
    """Return spots of one kind that are not blended and leave no trail."""
    n = len(frame)
    also, trail = np.full(n, -1), np.zeros(n)
    return TrueSpots(
        frame, x_px, y_px, magnitude, np.full(n, kind, np.int8), source, also, trail, trail
    )


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
    also: Indices


class Readout:
    """When the rows of frames are exposed, and the sensor's pose then.

    Frames have positions and velocities (f, 3), and `R` (f, 3, 3), sensor from ICRS, at their times
    `time_ns` (f,), which are those of the middle row.
    """

    def __init__(
        self,
        sensor: SimulatedSensor,
        attitudes: Attitudes,
        time_ns: Indices,
        r_km: Array,
        v_km_s: Array,
        attitude: Rotation,
    ) -> None:
        self._sensor, self._attitudes = sensor, attitudes
        self.time_ns, self.r_km, self.v_km_s = time_ns, r_km, v_km_s
        self.R = attitude.as_matrix()
        # Where a spot is depends on its row's time, and this on where it is.
        self.rounds = ROW_ROUNDS if sensor.optics.line_time_s else 0
        if self.rounds or sensor.jitter:
            # The jitter of a frame is one turn of the whole frame.
            self.jitter = attitude * attitudes.at(time_ns, r_km, v_km_s).inv()

    def times_ns(self, frame: Indices, y_px: Array) -> Indices:
        """Return the times of rows of frames; of the frame where a row is not known (NaN)."""
        optics = self._sensor.optics
        late_s = np.nan_to_num(y_px - (optics.height - 1) / 2) * optics.line_time_s
        return self.time_ns[frame] + np.rint(late_s * 1e9).astype(np.int64)

    def poses(self, frame: Indices, y_px: Array) -> tuple[Array, Array]:
        """Return positions (n, 3) and rotations (n, 3, 3) at the times of rows."""
        time_ns = self.times_ns(frame, y_px)
        r_km, v_km_s = self._sensor.path.at(seconds_since(self._sensor.t0_ns, time_ns))
        if not len(frame):
            return r_km, np.empty((0, 3, 3))
        attitude = self.jitter[frame] * self._attitudes.at(time_ns, r_km, v_km_s)
        return r_km, attitude.as_matrix()


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
            "false light", "centroid noise", "flux noise", "shuffle", "trail noise",
        )  # fmt: skip
        self._streams = {p: random_stream(sensor.seed, sensor.index, p) for p in purposes}
        self._hot = self._hot_pixels()
        self._neighbours = None if sensor.blend_px else self._close_stars()

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
        earth_km, earth_km_s = earth_at(time_ns)
        readout = Readout(s, self.attitudes, time_ns, r_km, v_km_s, attitude)
        stars = self._star_spots(readout, earth_km, earth_km_s + v_km_s)
        targets = self._target_spots(readout, earth_km_s)
        if s.blend_px:
            faintest = max(s.magnitude_limit, s.object_limit) + BLEND_DEPTH
            lit = _selected(targets, np.flatnonzero(targets.magnitude <= faintest))
            both = blended(_joined([stars, lit]), s.blend_px)
            stars = _selected(both, np.flatnonzero(both.kind == STAR))
            stars = _selected(stars, np.flatnonzero(stars.magnitude <= s.magnitude_limit))
            targets = _selected(both, np.flatnonzero(both.kind == TARGET))
        spots = [
            self._kept_stars(stars), self._detected(targets), self._false_spots(len(time_ns))
        ]  # fmt: skip
        return self._measure(_joined(spots), frame_number, time_ns, r_km, v_km_s, attitude)

    def _star_spots(self, readout: "Readout", earth_km: Array, v_km_s: Array) -> TrueSpots:
        field, r_km = self.stars, readout.r_km
        frame, star = stars_in_cones(field, readout.R[:, 2], self._radius + ABERRATION_ROOM)
        years = julian_years_since(field.epoch, readout.time_ns)
        u = star_directions(field, star, years[frame], (earth_km + r_km)[frame])
        clear = ~hidden_by_earth(r_km[frame], u, np.inf)
        frame, star, u = frame[clear], star[clear], u[clear]
        seen = boost(u, v_km_s[frame])
        x, y, ok = self._image(seen, readout.R[frame])
        for _ in range(readout.rounds):
            _, R = readout.poses(frame, y)
            x, y, ok = self._image(seen, R)
        frame, star, x, y = frame[ok], star[ok], x[ok], y[ok]
        if self._neighbours is not None:
            return self._merged(frame, star, x, y, self._neighbours)
        return true_spots(frame, x, y, field.magnitude[star], STAR, field.star_id[star])

    def _kept_stars(self, spots: TrueSpots) -> TrueSpots:
        """Return the spots of stars that are on the image and not missed."""
        s = self.sensor
        inside = on_image(s.optics, spots.x_px, spots.y_px)
        kept = self._streams["star drop"].random(int(inside.sum())) >= s.star_drop
        return _selected(spots, np.flatnonzero(inside)[kept])

    def _target_spots(self, readout: "Readout", earth_km_s: Array) -> TrueSpots:
        """Return the spots of all objects on the image, however faint."""
        s, objects, r_km, R = self.sensor, self.objects, readout.r_km, readout.R
        t_s = seconds_since(s.t0_ns, readout.time_ns)
        u_to_sun = np.empty((len(t_s), 3))
        if objects.need_sun:
            u_to_sun = directions_to_sun(readout.time_ns)
        after = self._later_pose(readout)
        none = np.empty(0)
        parts = [true_spots(np.empty(0, np.int64), none, none, none, TARGET, np.empty(0, np.int64))]
        for frame, target in self._pairs_about_field(t_s, r_km, R):
            states_at = partial(objects.paths.at, body=target)
            d, r_sent = received_from(states_at, t_s[frame], r_km[frame], earth_km_s[frame])
            distance = np.linalg.norm(d, axis=1)
            u = d / distance[:, None]
            ok = ~hidden_by_earth(r_km[frame], u, distance)
            v_observer = earth_km_s + readout.v_km_s
            x, y, inside = self._image(boost(u, v_observer[frame]), R[frame])
            middle = x, y  # as if all rows were exposed together
            for _ in range(readout.rounds):
                x, y, inside = self._at_rows(readout, frame, target, y, earth_km_s, v_observer)
            ok &= inside & on_image(s.optics, x, y)
            magnitude = objects.magnitudes(target, d, r_sent, u_to_sun[frame])
            frame, target, u, x, y = frame[ok], target[ok], u[ok], x[ok], y[ok]
            spots = true_spots(frame, x, y, magnitude[ok], TARGET, target)
            if after is not None:
                later = self._later_direction(t_s, r_km, d[ok], frame, target, after)
                later_x, later_y, _ = self._image(boost(later, v_observer[frame]), after[1][frame])
                # NaN where the trail leaves the camera's cone.
                spots.trail_x_px = np.nan_to_num(2 * (later_x - middle[0][ok]))
                spots.trail_y_px = np.nan_to_num(2 * (later_y - middle[1][ok]))
            parts.append(spots)
        return _joined(parts)

    def _at_rows(
        self,
        readout: "Readout",
        frame: Indices,
        target: Indices,
        y_px: Array,
        earth_km_s: Array,
        v_observer: Array,
    ) -> tuple[Array, Array, Flags]:
        """Return what `_image` does for objects at the times of these rows."""
        r_km, R = readout.poses(frame, y_px)
        t_s = seconds_since(self.sensor.t0_ns, readout.times_ns(frame, y_px))
        states_at = partial(self.objects.paths.at, body=target)
        d, _ = received_from(states_at, t_s, r_km, earth_km_s[frame])
        u = d / np.linalg.norm(d, axis=1, keepdims=True)
        return self._image(boost(u, v_observer[frame]), R)

    def _later_pose(self, readout: "Readout") -> tuple[Array, Array] | None:
        """Return positions and rotations at the end of each exposure; None without trails."""
        s = self.sensor
        if not s.trail_error:
            return None
        later_ns = readout.time_ns + round(s.exposure_s / 2 * 1e9)
        r_km, v_km_s = s.path.at(seconds_since(s.t0_ns, later_ns))
        attitude = self.attitudes.at(later_ns, r_km, v_km_s)
        if s.jitter:
            attitude = readout.jitter * attitude
        return r_km, attitude.as_matrix()

    def _later_direction(
        self,
        t_s: Array,
        r_km: Array,
        d_km: Array,
        frame: Indices,
        target: Indices,
        after: tuple[Array, Array],
    ) -> Array:
        """Return unit vectors to objects at the end of the exposure, from those at its middle."""
        half_s = self.sensor.exposure_s / 2
        _, v_km_s = self.objects.paths.at(t_s[frame], target)
        later = d_km + v_km_s * half_s - (after[0] - r_km)[frame]
        return later / np.linalg.norm(later, axis=1, keepdims=True)

    def _pairs_about_field(
        self, t_s: Array, r_km: Array, R: Array
    ) -> Iterator[tuple[Indices, Indices]]:
        """Yield the pairs of a frame and an object about its field, in order, a part at a time."""
        found: list[tuple[Indices, Indices]] = []
        n, most = len(self.objects), max(TARGETS_AT_ONCE // max(len(self.objects), 1), 1)
        low = 0
        while n and low < len(t_s):
            end = int(np.searchsorted(t_s, t_s[low] + SEGMENT_S, side="right"))
            high = min(max(end, low + 1), low + most)
            about = self._about_segment(t_s[low:high], r_km[low:high], R[low:high, 2])
            found.append(self._in_cone(t_s, r_km, R, np.arange(low, high), about))
            low = high
            if low == len(t_s) or sum(len(frame) for frame, _ in found) >= TARGETS_AT_ONCE:
                frames, targets = zip(*found, strict=True)
                yield np.concatenate(frames), np.concatenate(targets)
                found = []

    def _about_segment(self, t_s: Array, r_km: Array, boresight: Array) -> Indices:
        """Return the objects that may be in the field in one of a few neighbouring frames.

        None is left out that is there: objects, sensor and boresight are taken as they are in the
        middle, and the cone is wider by as much as they may move until the first and last frame.
        """
        middle = len(t_s) // 2
        moved_km = MAX_SPEED_KM_S * float(np.abs(t_s - t_s[middle]).max())
        moved_km += float(np.linalg.norm(r_km - r_km[middle], axis=1).max())
        turned = float(np.arccos(np.clip(boresight @ boresight[middle], -1, 1)).max())
        everything = np.arange(len(self.objects))
        d = self.objects.paths.at(t_s[middle], everything)[0] - r_km[middle]
        distance_km = np.maximum(np.linalg.norm(d, axis=1), 1e-9)
        room = np.arcsin(np.minimum(moved_km / distance_km, 1.0)) + turned + 1e-6
        half_angle = self._radius + ABERRATION_ROOM + room
        near = d @ boresight[middle] >= distance_km * np.cos(np.minimum(half_angle, np.pi))
        return np.flatnonzero(near | (distance_km <= moved_km) | (half_angle >= np.pi))

    def _in_cone(
        self, t_s: Array, r_km: Array, R: Array, of_frame: Indices, of_target: Indices
    ) -> tuple[Indices, Indices]:
        """Return those pairs of a frame and an object in which the object is about the field."""
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
        source = np.full(len(frame), -1)
        return true_spots(frame, x_y[:, 0], x_y[:, 1], magnitude, FALSE, source)

    def _image(self, u: Array, R: Array) -> tuple[Array, Array, Flags]:
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

    def _merged(
        self, frame: Indices, star: Indices, x: Array, y: Array, pairs: tuple[Indices, Indices]
    ) -> TrueSpots:
        """Return star spots; stars within MERGE_PX are one, with the number of the brightest."""
        n_stars = len(self.stars.star_id)
        key = frame * n_stars + star
        order = np.argsort(key, kind="stable")
        frame, star, x, y, key = frame[order], star[order], x[order], y[order], key[order]
        first, second = pairs
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
        return true_spots(
            frame[brightest],
            np.bincount(spot, light * x, n_spots) / total,
            np.bincount(spot, light * y, n_spots) / total,
            -2.5 * np.log10(total),
            STAR,
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
        if s.trail_error:
            along = s.trail_error * self._streams["trail noise"].standard_normal(len(order))
            x, y = x + along * spots.trail_x_px[order], y + along * spots.trail_y_px[order]
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
            spots.also[order][mixed],
        )


def _random_magnitudes(rng: np.random.Generator, n: int, limit: float) -> Array:
    """Return magnitudes spread as the sky's: star counts rise by 10^0.5 a magnitude."""
    return limit + 2 * np.log10(1 - rng.random(n))


def _selected(spots: TrueSpots, at: Indices) -> TrueSpots:
    return TrueSpots(*[getattr(spots, field.name)[at] for field in fields(spots)])


def _joined(parts: list[TrueSpots]) -> TrueSpots:
    names = [field.name for field in fields(TrueSpots)]
    return TrueSpots(*[np.concatenate([getattr(p, name) for p in parts]) for name in names])


def blended(spots: TrueSpots, width_px: float) -> TrueSpots:
    """Return the spots with those of a frame that are near each other as one.

    One spot lies at the middle of its light, with the kind, source and trail of its brightest part;
    `also` is the brightest other object in it. Spots in a chain of near ones are one.

    Parameters
    ----------
    width_px : float
        Spots of a frame that are nearer than this become one.
    """
    n = len(spots.frame)
    apart = spots.frame * (10.0 * width_px)
    tree = cKDTree(np.stack([spots.x_px, spots.y_px, apart], axis=1))
    pairs = tree.query_pairs(width_px, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    n_spots, spot = connected_components(links, directed=False)
    light = 10 ** (-0.4 * spots.magnitude)
    # The brightest part of each spot comes first in this order, in which the spots are sorted.
    order = np.lexsort((-light, spot))
    of, first = spot[order], np.searchsorted(spot[order], np.arange(n_spots))
    made = _selected(spots, order[first])
    total = np.bincount(spot, light, n_spots)
    made.x_px = np.bincount(spot, light * spots.x_px, n_spots) / total
    made.y_px = np.bincount(spot, light * spots.y_px, n_spots) / total
    made.magnitude = -2.5 * np.log10(total)
    hidden = (spots.kind[order] == TARGET) & (np.arange(n) != first[of])
    rows, at = np.unique(of[hidden], return_index=True)
    made.also[rows] = spots.source[order][hidden][at]
    return _selected(made, np.argsort(made.frame, kind="stable"))


def _nothing(
    frame_number: Indices, time_ns: Indices, r_km: Array, v_km_s: Array, attitude: Rotation
) -> Exposures:
    none, whole = np.empty(0), np.empty(0, np.int64)
    return Exposures(
        frame_number, time_ns, r_km, v_km_s, attitude, np.zeros(1, np.int64),
        none, none, none, none, np.empty(0, np.int8), whole, none, whole,
    )  # fmt: skip

"""A simulated sensor: pointing, times of exposure, attitudes, and the states that it reports."""

import zlib
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from epipole.schemas.arrays import Array, Flags, Integers, Nanoseconds
from epipole.tasks.algorithms.simulation.constants import EARTH_RADIUS_KM, SECOND_NS
from epipole.tasks.algorithms.simulation.optics import TrueOptics, hidden_by_earth
from epipole.tasks.algorithms.simulation.paths import Paths

# Pointing: attitudes that track an object, stay fixed, spin or jump.


def look_along(z: Array, up: Array, roll_rad: float = 0.0) -> Rotation:
    """Return the rotations, sensor from ICRS, with the boresight along (n, 3) directions.

    The image's upper edge (-y) is towards `up`, (3,) or (n, 3), then rolled about the boresight.
    """
    z = z / np.linalg.norm(z, axis=1, keepdims=True)
    y = -(up - np.einsum("ij,ij->i", z, np.broadcast_to(up, z.shape))[:, None] * z)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    R_sensor_from_icrs = np.stack([np.cross(y, z), y, z], axis=1)
    return Rotation.from_rotvec([0.0, 0.0, roll_rad]) * Rotation.from_matrix(R_sensor_from_icrs)


def body_fixed(
    r_km: Array, v_km_s: Array, azimuth_rad: float, elevation_rad: float, roll_rad: float
) -> Rotation:
    """Return attitudes, sensor from ICRS, that are fixed to the orbital frame of the sensor.

    The frame is radial (away from the Earth), across (the orbit's normal) and along, which
    completes it. Up in the image is radial; where the boresight is within a thousandth of a
    radian of that, it is along.

    Parameters
    ----------
    r_km, v_km_s : (n, 3) float
        Positions and velocities of the sensor, GCRF.
    azimuth_rad, elevation_rad : float
        Boresight, from along towards across, and from there towards radial.
    """
    radial = r_km / np.linalg.norm(r_km, axis=1, keepdims=True)
    across = np.cross(r_km, v_km_s)
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    along = np.cross(across, radial)
    level = np.cos(azimuth_rad) * along + np.sin(azimuth_rad) * across
    z = np.cos(elevation_rad) * level + np.sin(elevation_rad) * radial
    up = radial if abs(np.cos(elevation_rad)) > 1e-3 else along
    return look_along(z, up, roll_rad)


def azimuth_away(r_km: Array, v_km_s: Array, u: Array) -> float:
    """Return the azimuth [rad] of the horizontal away from a direction, see `body_fixed`.

    All are (3,): position and velocity of the sensor, and a unit vector, GCRF.
    """
    across = np.cross(r_km, v_km_s)
    along = np.cross(across, r_km)
    return float(
        np.arctan2(-u @ across / np.linalg.norm(across), -u @ along / np.linalg.norm(along))
    )


def spinning(start: Rotation, axis: Array, rate_rad_s: float, t_s: Array) -> Rotation:
    """Return attitudes, sensor from ICRS, of a constant rotation about an inertial axis."""
    turned = np.asarray(t_s)[:, None] * (rate_rad_s * axis / np.linalg.norm(axis))
    return start * Rotation.from_rotvec(turned).inv()


def random_attitudes(
    rng: np.random.Generator, r_sensor_km: Array, clearance_rad: float | None
) -> Rotation:
    """Return a uniformly random attitude, sensor from ICRS, for each sensor position (n, 3).

    With a clearance, the boresight is at least that far from the Earth's limb.
    """
    distance = np.linalg.norm(r_sensor_km, axis=1)
    limb = np.arcsin(np.minimum(EARTH_RADIUS_KM / distance, 1.0))
    # Four normal numbers, scaled to unit length, are uniform over all rotations.
    q = rng.standard_normal((len(r_sensor_km), 4))
    low = np.arange(len(q)) if clearance_rad is not None else np.arange(0)
    while len(low):
        boresight = Rotation.from_quat(q[low]).as_matrix()[:, 2]
        to_earth = -np.einsum("ij,ij->i", boresight, r_sensor_km[low]) / distance[low]
        low = low[np.arccos(np.clip(to_earth, -1, 1)) < limb[low] + clearance_rad]
        q[low] = rng.standard_normal((len(low), 4))
    return Rotation.from_quat(q)


# Exposures and reported states.


@dataclass(frozen=True)
class SimulatedSensor:
    """All parameters of a sensor, in radians, pixels, km and seconds."""

    sensor_id: str
    index: int
    seed: int
    t0_ns: int
    duration_s: float
    path: Paths  # of one body
    optics: TrueOptics
    # pointing
    mode: str  # track, fixed, spin, body, random
    followed: Paths | None  # track: of one body
    up: Array  # (3,)
    roll: float
    boresight: Array  # (3,) fixed, spin
    axis: Array  # (3,) spin
    spin_rate: float
    azimuth: float  # body
    elevation: float
    hold_s: float
    clearance: float | None
    skip_hidden: bool
    jitter: float
    # frames
    rate_hz: float
    phase: float
    exposure_s: float
    time_jitter_s: float
    frame_drop: float
    outages_s: tuple[tuple[float, float], ...]
    # detection
    magnitude_limit: float
    object_limit: float
    fade: float  # mag
    sigma_px: float
    faint_sigma_px: float
    flux_error: float
    false_points: float
    hot_pixels: int
    star_drop: float
    target_drop: float
    blend_px: float
    trail_error: float
    # states
    state_rate_hz: float
    state_margin_s: float
    position_noise_km: float
    position_bias_km: float
    prior_noise: float | None
    prior_bias: float
    # faults
    position_offset_km: Array  # (3,) GCRF
    position_told: bool
    prior_offset: Array  # (3,) about the sensor's axes
    prior_told: bool


def random_stream(seed: int, index: int, purpose: str) -> np.random.Generator:
    """Return the stream of random numbers of a sensor (or group) for one purpose.

    Each purpose has another stream, so that switching on one effect does not change the others.
    """
    return np.random.default_rng([seed, index, zlib.crc32(purpose.encode())])


def seconds_since(t0_ns: int, time_ns: Nanoseconds) -> Array:
    """Return seconds since the scene's start."""
    return (np.asarray(time_ns, np.int64) - t0_ns) / SECOND_NS


def frame_times(sensor: SimulatedSensor) -> tuple[Integers, Nanoseconds]:
    """Return frame numbers and mid-exposure times [ns] of all frames of the sensor."""
    n = max(int(np.ceil(sensor.duration_s * sensor.rate_hz - sensor.phase - 1e-9)), 0)
    number = np.arange(n, dtype=np.int64)
    t = (number + sensor.phase) / sensor.rate_hz
    if sensor.time_jitter_s:
        rng = random_stream(sensor.seed, sensor.index, "frame times")
        most = 0.4 / sensor.rate_hz  # keeps the frames in order
        t = t + np.clip(rng.standard_normal(n) * sensor.time_jitter_s, -most, most)
    keep = (t >= 0) & (t < sensor.duration_s)
    for start, end in sensor.outages_s:
        keep &= (t < start) | (t >= end)
    if sensor.frame_drop:
        rng = random_stream(sensor.seed, sensor.index, "frame drops")
        keep &= rng.random(n) >= sensor.frame_drop
    time_ns = sensor.t0_ns + np.rint(t * SECOND_NS).astype(np.int64)
    return number[keep], time_ns[keep]


class Attitudes:
    """The sensor's attitude over the whole scene, without the jitter of single frames."""

    def __init__(self, sensor: SimulatedSensor) -> None:
        self.sensor = sensor
        self._random = Rotation.identity(1)
        if sensor.mode == "random":
            n = int(np.ceil(sensor.duration_s / sensor.hold_s)) + 2
            # One more hold on either side, for the states beyond the ends.
            middle: Array = (np.arange(n, dtype=float) - 0.5) * sensor.hold_s
            r_km, _ = sensor.path.at(middle)
            rng = random_stream(sensor.seed, sensor.index, "attitudes")
            self._random = random_attitudes(rng, r_km, sensor.clearance)

    def at(self, time_ns: Nanoseconds, r_km: Array, v_km_s: Array) -> Rotation:
        """Return attitudes, sensor from ICRS, at times with sensor states (n, 3) GCRF."""
        s = self.sensor
        t_s = seconds_since(s.t0_ns, time_ns)
        if s.mode == "random":
            hold = np.floor((t_s * s.rate_hz - s.phase + 0.5) / (s.hold_s * s.rate_hz)).astype(int)
            return self._random[np.clip(hold + 1, 0, len(self._random) - 1)]
        if s.followed is not None:
            followed_km, _ = s.followed.at(t_s)
            return look_along(followed_km - r_km, s.up, s.roll)
        if s.mode == "body":
            return body_fixed(r_km, v_km_s, s.azimuth, s.elevation, s.roll)
        start = look_along(s.boresight[None, :], s.up, s.roll)
        if s.mode == "fixed":
            return start[np.zeros(len(t_s), int)]
        return spinning(start[np.zeros(len(t_s), int)], s.axis, s.spin_rate, t_s)


def boresight_hidden(r_km: Array, attitude: Rotation) -> Flags:
    """Return which boresights meet the Earth."""
    return hidden_by_earth(r_km, attitude.as_matrix()[:, 2], np.inf)


def state_times(sensor: SimulatedSensor) -> Nanoseconds:
    """Return the times [ns] of the sensor's states, with a margin beyond the scene's ends."""
    first = -np.floor(sensor.state_margin_s * sensor.state_rate_hz)
    n = (
        int(np.floor((sensor.duration_s + sensor.state_margin_s) * sensor.state_rate_hz - first))
        + 1
    )
    t = (first + np.arange(n)) / sensor.state_rate_hz
    return sensor.t0_ns + np.rint(t * SECOND_NS).astype(np.int64)


class Beliefs:
    """Reported positions and attitudes: the truth plus a bias, a fault and noise."""

    def __init__(self, sensor: SimulatedSensor) -> None:
        self.sensor = sensor
        self._bias_km = self._stream("position bias").standard_normal(3) * sensor.position_bias_km
        self._bias_km += sensor.position_offset_km
        self._bias = self._stream("attitude bias").standard_normal(3) * sensor.prior_bias
        self._bias += sensor.prior_offset
        self._position_noise = self._stream("position noise")
        self._attitude_noise = self._stream("attitude noise")

    def _stream(self, purpose: str) -> np.random.Generator:
        return random_stream(self.sensor.seed, self.sensor.index, purpose)

    @property
    def position_sigma_km(self) -> float:
        """Return the reported sigma per axis of positions. An offset counts if it is stated."""
        s = self.sensor
        stated = _per_axis(s.position_offset_km) if s.position_told else 0.0
        return float(np.hypot(np.hypot(s.position_noise_km, s.position_bias_km), stated))

    @property
    def attitude_sigma(self) -> float:
        """Return the reported sigma per axis of attitudes [rad], 0 where none are reported."""
        s = self.sensor
        if s.prior_noise is None:
            return 0.0
        stated = _per_axis(s.prior_offset) if s.prior_told else 0.0
        return float(np.hypot(np.hypot(s.prior_noise, s.prior_bias), stated))

    def position(self, r_km: Array) -> Array:
        """Return reported positions for true ones; call in order of time."""
        noise = self._position_noise.standard_normal(r_km.shape)
        return r_km + self._bias_km + noise * self.sensor.position_noise_km

    def attitude(self, true: Rotation) -> Rotation | None:
        """Return reported attitudes for true ones, None for a sensor that reports none."""
        if self.sensor.prior_noise is None:
            return None
        noise = self._attitude_noise.standard_normal((len(true), 3)) * self.sensor.prior_noise
        return Rotation.from_rotvec(self._bias + noise) * true


def _per_axis(offset: Array) -> float:
    """Return the root mean square of the components of an offset (3,)."""
    return float(np.linalg.norm(offset) / np.sqrt(3.0))

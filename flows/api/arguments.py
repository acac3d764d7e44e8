"""Arguments of the public functions: arrays of the right shape, times; one clear error."""

import datetime
from typing import Any

import numpy as np
import numpy.typing as npt

from epipole.io.logs.messages.cameras import optics_fault
from epipole.schemas.arrays import Array, Integers
from epipole.schemas.log_bounds import QUATERNION, SPEED, TIME
from epipole.tasks.algorithms.geometry.camera import Camera

Time = datetime.datetime | np.datetime64 | str | int


def floats(
    name: str, values: Any, *shape: int | str, default: float | None = None, repeat: bool = False
) -> Array:
    """Return values as floats of this shape; a letter stands for any length.

    With `default`, None is that value everywhere. With `repeat`, values with fewer axes are
    repeated along the first ones.

    Raises
    ------
    ValueError
        Names the argument, its shape and the shape that is expected.
    """
    lengths = [n if isinstance(n, int) else None for n in shape]
    if np.ma.is_masked(values):
        raise ValueError(
            f"{name}: has {np.ma.count_masked(values)} masked values; leave them out, or fill them"
        )
    if values is None and default is not None:
        return np.full([n or 0 for n in lengths], default)
    try:
        out = np.asarray(values, float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: not an array of numbers ({error})") from error
    given = out.shape
    if repeat and out.ndim < len(shape):
        out = out[(None,) * (len(shape) - out.ndim)]
        once = [
            n if m == 1 and n is not None else m for n, m in zip(lengths, out.shape, strict=True)
        ]
        out = np.broadcast_to(out, once)
    if out.ndim != len(shape) or any(
        n is not None and n != m for n, m in zip(lengths, out.shape, strict=True)
    ):
        wanted = ", ".join(map(str, shape)) + ("," if len(shape) == 1 else "")
        raise ValueError(f"{name}: has shape {given}, expected ({wanted})")
    return out


def integers(name: str, values: Any, n: int) -> Integers:
    """Return values as (n,) integers.

    Raises
    ------
    ValueError
        Where one is not whole, or the shape is wrong.
    """
    given = floats(name, values, n)
    out = np.asarray(values)
    if out.dtype.kind not in "iu" and not (given == np.rint(given)).all():
        wrong = given[~(given == np.rint(given))][0]
        raise ValueError(f"{name}: has {wrong:g}, expected whole numbers")
    return out.astype(np.int64) if out.dtype.kind in "iu" else given.astype(np.int64)


def optics(name: str, camera: Any) -> Camera:
    """Return a camera that a log may have.

    Raises
    ------
    ValueError
        Where it has other fields, or numbers that a log would be refused for.
    """
    try:
        given = Camera(*camera)
        numbers = [float(value) for value in given]
    except (TypeError, ValueError) as error:
        fields = ", ".join(Camera._fields)
        raise ValueError(f"{name}: is no Camera of numbers {fields} ({error})") from error
    width, height, fx, fy, cx, cy, *distortion, _, line_time_s = numbers
    if width % 1 or height % 1:
        raise ValueError(f"{name}: width and height are {width:g} and {height:g}, expected whole")
    K = (fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0)
    fault = optics_fault(
        (int(width), int(height)), K, tuple(distortion), bool(given.fisheye), line_time_s
    )
    if fault is not None:
        raise ValueError(f"{name}: {fault.value}: {fault.sentence} It is {given}")
    return given


def unit_quaternion(name: str, q: Array) -> Array:
    """Return a quaternion (4,) as it is.

    Raises
    ------
    ValueError
        Where its length is not 1, within a hundredth.
    """
    length = float(np.linalg.norm(q))
    if not QUATERNION.minimum < length < QUATERNION.maximum:
        raise ValueError(f"{name}: has length {length:.3g}, expected a unit quaternion")
    return q


def sigma(name: str, value: Any) -> float:
    """Return a 1-sigma error.

    Raises
    ------
    ValueError
        Where it is not a number, or below 0.
    """
    given = float(floats(name, value))
    if not given >= 0.0:
        raise ValueError(f"{name}: is {given:g}, expected 0 or more")
    return given


# [km] No sensor is farther; a position above the ground in metres is.
FARTHEST_KM = 5e6


def _require_numbers(name: str, values: Array, hint: str = "") -> None:
    if not np.isfinite(values).all():
        raise ValueError(f"{name}: is {values.tolist()}, expected numbers{hint}")


def position(name: str, position_km: Any) -> Array:
    """Return a sensor's position (3,) [km].

    Raises
    ------
    ValueError
        Where it is not a number, or so far away that it may be in metres.
    """
    r = floats(name, position_km, 3)
    _require_numbers(name, r)
    distance = float(np.linalg.norm(r))
    if distance > FARTHEST_KM:
        raise ValueError(
            f"{name}: {distance:.4g} km from the Earth's centre, expected at most "
            f"{FARTHEST_KM:.4g}; is it in m?"
        )
    return r


def velocity(velocity_km_s: Any, default: float | None = None) -> Array:
    """Return a sensor's velocity (3,) [km/s]; with `default`, None is that value.

    Raises
    ------
    ValueError
        Where it is not a number, or a log's velocity would be refused too: it may be in m/s.
    """
    v = floats("velocity_km_s", velocity_km_s, 3, default=default)
    if velocity_km_s is not None:
        hint = "" if default is None else "; give None where it is unknown"
        _require_numbers("velocity_km_s", v, hint)
    speed = float(np.linalg.norm(v))
    if speed > SPEED.maximum:
        raise ValueError(
            f"velocity_km_s: {speed:.4g} km/s, expected at most {SPEED.maximum:.4g}; is it in m/s?"
        )
    return v


def nanoseconds(name: str, times: Any) -> npt.NDArray[np.int64]:
    """Return numpy.datetime64 of any unit as integer nanoseconds since 1970, UTC.

    Raises
    ------
    ValueError
        Where one is beyond what nanoseconds can hold, the years 1678 to 2261.
    """
    given = np.asarray(times)
    at_ns = given.astype("datetime64[ns]")
    # Years, compared as such: a cast to nanoseconds wraps silently.
    year, cast = (values.astype("datetime64[Y]") for values in (given, at_ns))
    wrapped = (year != cast) & ~np.isnat(given)
    if wrapped.any():
        raise ValueError(f"{name}: {given[wrapped].flat[0]} is beyond the years 1678 to 2261")
    return np.asarray(at_ns.astype(np.int64))


def require_nanoseconds(name: str, lowest: int) -> None:
    """Raise a ValueError where an integer of nanoseconds is before the times that a log may have.

    Seconds, milliseconds and microseconds of our days are nanoseconds of 1970.
    """
    if lowest < TIME.minimum:
        raise ValueError(f"{name}: {lowest} ns is before 1972, expected nanoseconds since 1970")


def time_ns(time: Time) -> int:
    """Return a time as integer nanoseconds since 1970, UTC. A time without a zone is UTC.

    Raises
    ------
    ValueError
        Where it is not a time, or an integer of nanoseconds before 1972.
    """
    if isinstance(time, np.datetime64) and not np.isnat(time):
        return int(nanoseconds("time", time))
    if isinstance(time, int | np.integer) and not isinstance(time, bool):
        require_nanoseconds("time", int(time))
    try:
        if isinstance(time, int | np.integer) and not isinstance(time, bool):
            return int(np.int64(int(time)))
        if isinstance(time, str):
            time = datetime.datetime.fromisoformat(time)
        if isinstance(time, datetime.datetime):
            zone = time.tzinfo or datetime.UTC
            since = time.replace(tzinfo=zone) - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
            return int(np.int64((since // datetime.timedelta(microseconds=1)) * 1000))
    except (ValueError, OverflowError) as error:
        raise ValueError(f"time: {error}") from error
    raise ValueError(f"time: {time!r} is not a time; give a datetime, or nanoseconds since 1970")

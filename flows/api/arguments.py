"""Arguments of the public functions: arrays of the right shape, times; one clear error."""

import datetime
from typing import Any

import numpy as np

from epipole.schemas.arrays import Array
from epipole.schemas.log_bounds import QUATERNION, SPEED

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


def velocity(velocity_km_s: Any, default: float | None = None) -> Array:
    """Return a sensor's velocity (3,) [km/s]; with `default`, None is that value.

    Raises
    ------
    ValueError
        Where a log's velocity would be refused too: it may be in m/s.
    """
    v = floats("velocity_km_s", velocity_km_s, 3, default=default)
    speed = float(np.linalg.norm(v))
    if speed > SPEED.maximum:
        raise ValueError(
            f"velocity_km_s: {speed:.4g} km/s, expected at most {SPEED.maximum:.4g}; is it in m/s?"
        )
    return v


def time_ns(time: Time) -> int:
    """Return a time as integer nanoseconds since 1970, UTC. A time without a zone is UTC.

    Raises
    ------
    ValueError
        Where it is not a time.
    """
    try:
        if isinstance(time, int | np.integer) and not isinstance(time, bool):
            return int(np.int64(int(time)))
        if isinstance(time, str):
            time = datetime.datetime.fromisoformat(time)
        if isinstance(time, datetime.datetime):
            zone = time.tzinfo or datetime.UTC
            since = time.replace(tzinfo=zone) - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
            return int(np.int64((since // datetime.timedelta(microseconds=1)) * 1000))
        if isinstance(time, np.datetime64) and not np.isnat(time):
            return int(time.astype("datetime64[ns]").astype(np.int64))
    except (ValueError, OverflowError) as error:
        raise ValueError(f"time: {error}") from error
    raise ValueError(f"time: {time!r} is not a time; give a datetime, or nanoseconds since 1970")

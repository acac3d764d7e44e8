"""Messages as they mostly are, read from a chunk's bytes by compiled loops.

A scan takes messages one after the other, straight into columns, as long as they are
good: of known encoding, well formed, every value usable. At the first one that is not it
stops, and the decoder of `message_decoding` judges that one: it knows all that is allowed
(arrays in pieces, numbers one by one, big-endian CDR, JSON) and why something is not. So
what a scan takes is what the decoder would take, and nothing is judged in two ways.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from epipole.io.logs.kernels import kernel
from epipole.io.logs.mcap.byte_loads import load_int32, load_uint64
from epipole.io.logs.mcap.record_scan import Bytes
from epipole.io.logs.messages.wire import parse

MAX_NAMES = 1024  # sensors that a scan can tell apart; the decoder knows no limit
NAME_BYTES = 63
INFINITY_BITS, NAN_BITS = np.int32(0x7F800000), np.int32(0x7FC00000)  # of a float32

# What a state may have for a scan to take it: narrower than the decoder's limits by more
# than rounding, which it is left to judge.
NEAREST_KM, FARTHEST_KM = 6341.0, 9.9e6
MIN_NORM2, MAX_NORM2 = 0.985, 1.015  # of a quaternion, squared


class Messages(NamedTuple):
    """Messages of one kind in a chunk's bytes."""

    data: Bytes
    start: npt.NDArray[np.int64]
    end: npt.NDArray[np.int64]
    encoding: npt.NDArray[np.uint8]  # as in `message_wire`
    channel: npt.NDArray[np.uint16]


class Names(NamedTuple):
    """Names met so far; a name's code is its row."""

    text: npt.NDArray[np.uint8]  # (MAX_NAMES, NAME_BYTES)
    length: npt.NDArray[np.int64]
    n_met: npt.NDArray[np.int64]  # (1,)
    hint: npt.NDArray[np.int64]  # (65536,) the code last met on a channel


def new_names() -> Names:
    """Return a table of no names."""
    text = np.zeros((MAX_NAMES, NAME_BYTES), np.uint8)
    return Names(text, *(np.zeros(n, np.int64) for n in (MAX_NAMES, 1, 65536)))


class FrameRows(NamedTuple):
    """Columns of frames, and of the centroids of all of them, with room at their ends."""

    sensor: npt.NDArray[np.int32]
    number: npt.NDArray[np.int64]
    time_ns: npt.NDArray[np.int64]
    exposure_s: npt.NDArray[np.float64]
    first: npt.NDArray[np.int32]  # one more than frames: where a frame's centroids begin
    has_flux: npt.NDArray[np.bool_]
    has_sigma: npt.NDArray[np.bool_]
    x_px: npt.NDArray[np.float32]
    y_px: npt.NDArray[np.float32]
    flux: npt.NDArray[np.float32]  # NaN where unknown
    sigma_px: npt.NDArray[np.float32]  # NaN where unknown


class StateRows(NamedTuple):
    """Columns of states, with room at their ends."""

    sensor: npt.NDArray[np.int32]
    frame: npt.NDArray[np.int32]
    time_ns: npt.NDArray[np.int64]
    r_km: npt.NDArray[np.float64]  # (n, 3)
    v_km_s: npt.NDArray[np.float64]  # (n, 3), NaN where not sent
    q: npt.NDArray[np.float64]  # (n, 4) as sent, NaN where not
    sigma: npt.NDArray[np.float64]  # (n, 2) of position [km] and attitude [arcsec], as sent


@kernel
def _valid_id(data, at, n):
    """Return whether a text is a sensor id."""
    if n < 1 or n > NAME_BYTES:
        return False
    for k in range(n):
        c = data[at + k]
        letter = (65 <= c <= 90) or (97 <= c <= 122) or (48 <= c <= 57)
        if not letter and not (k > 0 and (c == 45 or c == 95)):
            return False
    return True


@kernel
def _same(data, at, n, names, code):
    if names.length[code] != n:
        return False
    for k in range(n):  # noqa: SIM110 (numba knows no generator expressions)
        if names.text[code, k] != data[at + k]:
            return False
    return True


@kernel
def _find(data, at, n, names):
    """Return the code of a name, or -1."""
    for code in range(names.n_met[0]):
        if _same(data, at, n, names, code):
            return code
    return -1


@kernel
def _sensor(data, at, n, names, channel):
    """Return the code of a sensor id, new or known; -1 where it is no id or there is no room."""
    code = names.hint[channel]
    if code < names.n_met[0] and _same(data, at, n, names, code):
        return code
    if not _valid_id(data, at, n):
        return -1
    code = _find(data, at, n, names)
    if code < 0:
        code = names.n_met[0]
        if code == MAX_NAMES:
            return -1
        names.text[code, :n] = data[at : at + n]
        names.length[code] = n
        names.n_met[0] = code + 1
    names.hint[channel] = code
    return code


@kernel
def _copy_places(data, at, bits, low, n):
    """Copy the bits of float32 from byte `at` on; return whether all are finite."""
    to, bad = np.uint64(low), np.int32(0)  # unsigned: no index counts from the end
    for k in range(n):
        value = load_int32(data, at + 4 * k)
        bits[to + np.uint64(k)] = value
        bad |= np.int32((value & INFINITY_BITS) == INFINITY_BITS)
    return bad == 0


@kernel
def _copy_positive(data, at, n_sent, bits, low, n):
    """Copy the bits of float32, NaN where one is not positive and finite or none was sent.

    Return whether all that were sent are.
    """
    to, bad = np.uint64(low), np.int32(0)
    if not n_sent:
        for k in range(n):
            bits[to + np.uint64(k)] = NAN_BITS
        return True
    for k in range(n):
        value = load_int32(data, at + 4 * k)
        wrong = (value <= 0) | (value >= INFINITY_BITS)
        bits[to + np.uint64(k)] = NAN_BITS if wrong else value
        bad |= np.int32(wrong)
    return bad == 0


@kernel
def scan_frames(messages, i, names, rows, n, kinds):
    """Take good frames from message `i` on, as rows from `n` on; return both where it ends.

    The rows must have room for all messages, and for an eighth of their bytes in centroids.
    """
    fields = np.zeros(2 * len(kinds), np.int64)
    # Each array taken out of its tuple once: that counts references, which takes its time.
    data, start, end, encoding, channel = messages
    sensor, number, time_ns, exposure_s, first, has_flux, has_sigma = rows[:7]
    x_bits, y_bits = rows.x_px.view(np.int32), rows.y_px.view(np.int32)
    flux_bits, sigma_bits = rows.flux.view(np.int32), rows.sigma_px.view(np.int32)
    low = np.int64(first[n])
    while i < len(start):
        if not parse(data, start[i], end[i], encoding[i], kinds, fields):
            break
        size, n_flux, n_sigma = fields[11], fields[15], fields[17]
        if fields[13] != size or (n_flux and n_flux != size) or (n_sigma and n_sigma != size):
            break
        if fields[6] < 0:  # a number of 2**63 or more
            break
        good = _copy_places(data, fields[10], x_bits, low, size)
        good &= _copy_places(data, fields[12], y_bits, low, size)
        good &= _copy_positive(data, fields[16], n_sigma, sigma_bits, low, size)
        if not good:
            break
        _copy_positive(data, fields[14], n_flux, flux_bits, low, size)
        code = _sensor(data, fields[4], fields[5], names, channel[i])
        if code < 0:
            break
        low += size
        sensor[n], number[n], time_ns[n], first[n + 1] = code, fields[6], fields[2], low
        exposed_s = np.uint64(fields[8]).view(np.float64)
        exposure_s[n] = exposed_s if 0 < exposed_s < np.inf else 0.0
        has_flux[n], has_sigma[n] = n_flux > 0, n_sigma > 0
        i += 1
        n += 1
    return i, n


@kernel
def _copy_doubles(data, at, n_sent, row):
    """Copy a vector, or NaN where none was sent; return the sum of its squares."""
    total = 0.0
    for k in range(len(row)):
        bits = load_uint64(data, at + 8 * k) if n_sent else np.uint64(0)
        row[k] = np.uint64(bits).view(np.float64) if n_sent else np.nan
        total += row[k] ** 2
    return total


@kernel
def scan_states(messages, i, names, frames, rows, n, kinds):
    """Take good states from message `i` on, as rows from `n` on; return both where it ends.

    `frames` are the names of reference frames that are known.
    """
    fields = np.zeros(2 * len(kinds), np.int64)
    data, start, end, encoding, channel = messages
    while i < len(start):
        if not parse(data, start[i], end[i], encoding[i], kinds, fields):
            break
        n_velocity, n_attitude = fields[11], fields[15]
        if fields[9] != 3 or n_velocity not in (0, 3) or n_attitude not in (0, 4):
            break
        radius2 = _copy_doubles(data, fields[8], 3, rows.r_km[n])
        if not NEAREST_KM**2 < radius2 < FARTHEST_KM**2:
            break
        speed2 = _copy_doubles(data, fields[10], n_velocity, rows.v_km_s[n])
        if n_velocity and not speed2 < np.inf:
            break
        norm2 = _copy_doubles(data, fields[14], n_attitude, rows.q[n])
        if n_attitude and not MIN_NORM2 < norm2 < MAX_NORM2:
            break
        frame = _find(data, fields[6], fields[7], frames)
        code = _sensor(data, fields[4], fields[5], names, channel[i])
        if frame < 0 or code < 0:
            break
        rows.sensor[n], rows.frame[n], rows.time_ns[n] = code, frame, fields[2]
        rows.sigma[n, 0] = np.uint64(fields[12]).view(np.float64)
        rows.sigma[n, 1] = np.uint64(fields[16]).view(np.float64)
        i += 1
        n += 1
    return i, n

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
from numba import njit

from epipole.io.record_scan import Bytes, little_endian
from epipole.schemas.messages import CENTROID_FRAME, SENSOR_STATE, MessageType

# How a message is encoded, as the scans know it.
OTHER, PROTOBUF, CDR = range(3)
# What a field is, by its number; 0 is a field that the message does not have.
UNKNOWN, TIME, TEXT, INTEGER, DOUBLE, FLOATS, DOUBLES = range(7)

MAX_SECONDS = 9_223_372_035  # whole ones that fit into nanoseconds
SECOND_NS = 1_000_000_000
MAX_NAMES = 1024  # sensors that a scan can tell apart; the decoder knows no limit
NAME_BYTES = 63
INFINITY_BITS, NAN_BITS = 0x7F800000, 0x7FC00000  # of a float32

# What a state may have for a scan to take it: narrower than the decoder's limits by more
# than rounding, which it is left to judge.
NEAREST_KM, FARTHEST_KM = 6341.0, 9.9e6
MIN_NORM2, MAX_NORM2 = 0.985, 1.015  # of a quaternion, squared


def _kinds(message: MessageType) -> npt.NDArray[np.int64]:
    """Return what each field of a message is, by its number; they count from 1, in order."""
    kinds = np.zeros(len(message.members) + 1, np.int64)
    scalars = {"time": TIME, "string": TEXT, "uint64": INTEGER, "double": DOUBLE}
    arrays = {"float": FLOATS, "double": DOUBLES}
    for place, member in enumerate(message.members, start=1):
        if member.number != place:
            raise ValueError(f"{message.name}: {member.name} is not field {place}")
        kinds[place] = arrays[member.kind] if member.repeated else scalars[member.kind]
    return kinds


FRAME_KINDS, STATE_KINDS = _kinds(CENTROID_FRAME), _kinds(SENSOR_STATE)


class Messages(NamedTuple):
    """Messages of one kind in a chunk's bytes."""

    data: Bytes
    start: npt.NDArray[np.int64]
    end: npt.NDArray[np.int64]
    encoding: npt.NDArray[np.uint8]  # OTHER, PROTOBUF or CDR
    channel: npt.NDArray[np.uint16]


class Names(NamedTuple):
    """Names met so far; a name's code is its row."""

    text: npt.NDArray[np.uint8]  # (MAX_NAMES, NAME_BYTES)
    length: npt.NDArray[np.int64]
    count: npt.NDArray[np.int64]  # (1,)
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


# One message's fields: fields[2 f] and fields[2 f + 1] of field number f are
# the time in ns, an integer, a double's bits, or the place and the length of a text or array.


@njit(nogil=True, cache=True)
def _varint(data, at, end):
    """Return a varint and the place behind it, which is -1 where it is none."""
    value, shift = np.uint64(0), np.uint64(0)
    for k in range(at, min(at + 9, end)):
        value |= np.uint64(data[k] & 0x7F) << shift
        if data[k] < 0x80:
            return value, k + 1
        shift += np.uint64(7)
    return value, -1


@njit(nogil=True, cache=True)
def _protobuf_time(data, at, end):
    """Return a Timestamp's nanoseconds, or 0 where it is none that a log can have."""
    seconds, nanos = np.uint64(0), np.uint64(0)
    while at < end:
        tag = data[at]
        value, at = _varint(data, at + 1, end)
        if at < 0:
            return 0
        if tag == 0x08:
            seconds = value
        elif tag == 0x10:
            nanos = value
        else:
            return 0
    if seconds > np.uint64(MAX_SECONDS) or nanos >= np.uint64(SECOND_NS):
        return 0
    return np.int64(seconds) * SECOND_NS + np.int64(nanos)


@njit(nogil=True, cache=True)
def _parse_protobuf(data, at, end, kinds, fields):
    """Fill in the fields of a message; return whether it is one that a scan may take."""
    fields[:] = 0
    seen = 0
    while at < end:
        tag, at = _varint(data, at, end)
        if at < 0 or tag > np.uint64(0xFFFFFFFF):
            return False
        number, wire = np.int64(tag >> np.uint64(3)), np.int64(tag & np.uint64(7))
        kind = kinds[number] if number < len(kinds) else UNKNOWN
        if kind != UNKNOWN:
            if seen >> number & 1:
                return False
            seen |= 1 << number
        elif number == 0:
            return False
        if wire == 2:
            size, at = _varint(data, at, end)
            if at < 0 or size > np.uint64(end - at):
                return False
            length = np.int64(size)
            if kind in (FLOATS, DOUBLES):
                width = 4 if kind == FLOATS else 8
                if length % width:
                    return False
                fields[2 * number], fields[2 * number + 1] = at, length // width
            elif kind == TEXT:
                fields[2 * number], fields[2 * number + 1] = at, length
            elif kind == TIME:
                fields[2 * number] = _protobuf_time(data, at, at + length)
            elif kind != UNKNOWN:
                return False
            at += length
        elif wire == 0:
            value, at = _varint(data, at, end)
            if at < 0 or (kind != UNKNOWN and kind != INTEGER):
                return False
            if kind == INTEGER:
                fields[2 * number] = np.int64(value)  # below 2**63: nine bytes hold no more
        elif wire == 1 or wire == 5:
            width = 8 if wire == 1 else 4
            if end - at < width or (kind != UNKNOWN and (kind != DOUBLE or wire == 5)):
                return False
            if kind == DOUBLE:
                fields[2 * number] = np.int64(little_endian(data, at, 8))
            at += width
        else:
            return False
    return True


@njit(nogil=True, cache=True)
def _parse_cdr(data, at, end, kinds, fields):
    """Fill in the fields of a little-endian message; return whether a scan may take it."""
    fields[:] = 0
    if end - at < 4 or data[at] != 0 or (data[at + 1] != 1 and data[at + 1] != 7):
        return False
    widest = 8 if data[at + 1] == 1 else 4
    origin = at + 4
    at = origin
    for number in range(1, len(kinds)):
        kind = kinds[number]
        width = 8 if kind in (INTEGER, DOUBLE) else 4
        at += -(at - origin) % min(width, widest)
        if end - at < width:
            return False
        if kind in (INTEGER, DOUBLE):
            fields[2 * number] = np.int64(little_endian(data, at, 8))
            at += 8
            continue
        head = np.int64(little_endian(data, at, 4))
        at += 4
        if kind == TIME:
            if end - at < 4:
                return False
            nanos = np.int64(little_endian(data, at, 4))
            at += 4
            if head > 0x7FFFFFFF or nanos >= SECOND_NS:
                return False
            fields[2 * number] = head * SECOND_NS + nanos
            continue
        size = 8 if kind == DOUBLES else 4 if kind == FLOATS else 1
        if size > 1 and head:
            at += -(at - origin) % min(size, widest)
        if head > (end - at) // size:
            return False
        fields[2 * number], fields[2 * number + 1] = at, head
        at += head * size
        if kind == TEXT and head and data[at - 1] == 0:
            fields[2 * number + 1] = head - 1
    return True


@njit(nogil=True, cache=True)
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


@njit(nogil=True, cache=True)
def _same(data, at, n, names, code):
    if names.length[code] != n:
        return False
    for k in range(n):  # noqa: SIM110 (numba knows no generator expressions)
        if names.text[code, k] != data[at + k]:
            return False
    return True


@njit(nogil=True, cache=True)
def _find(data, at, n, names):
    """Return the code of a name, or -1."""
    for code in range(names.count[0]):
        if _same(data, at, n, names, code):
            return code
    return -1


@njit(nogil=True, cache=True)
def _sensor(data, at, n, names, channel):
    """Return the code of a sensor id, new or known; -1 where it is no id or there is no room."""
    code = names.hint[channel]
    if code < names.count[0] and _same(data, at, n, names, code):
        return code
    if not _valid_id(data, at, n):
        return -1
    code = _find(data, at, n, names)
    if code < 0:
        code = names.count[0]
        if code == MAX_NAMES:
            return -1
        names.text[code, :n] = data[at : at + n]
        names.length[code] = n
        names.count[0] = code + 1
    names.hint[channel] = code
    return code


@njit(nogil=True, cache=True)
def _parse(messages, i, kinds, fields):
    """Return whether message `i` is well formed and has a time, and fill in its fields."""
    data, start, end = messages.data, messages.start[i], messages.end[i]
    if messages.encoding[i] == PROTOBUF:
        good = _parse_protobuf(data, start, end, kinds, fields)
    elif messages.encoding[i] == CDR:
        good = _parse_cdr(data, start, end, kinds, fields)
    else:
        good = False
    return good and fields[2] > 0


@njit(nogil=True, cache=True)
def _copy_places(data, at, column, low, n):
    """Copy float32 as they stand; return how many are not finite."""
    # Not aligned as the type promises, which no processor that numba compiles for minds.
    sent, bits = data[at : at + 4 * n].view(np.int32), column[low : low + n].view(np.int32)
    bad = 0
    for k in range(n):
        bits[k] = sent[k]
        bad += (sent[k] & INFINITY_BITS) == INFINITY_BITS
    return bad


@njit(nogil=True, cache=True)
def _copy_positive(data, at, n_sent, column, low, n):
    """Copy float32, NaN where one is not positive and finite or none was sent.

    Return how many of those sent are not.
    """
    bits = column[low : low + n].view(np.int32)
    if not n_sent:
        bits[:] = NAN_BITS
        return 0
    sent = data[at : at + 4 * n].view(np.int32)
    bad = 0
    for k in range(n):
        wrong = (sent[k] <= 0) | (sent[k] >= INFINITY_BITS)
        bits[k] = NAN_BITS if wrong else sent[k]
        bad += wrong
    return bad


@njit(nogil=True, cache=True)
def scan_frames(messages, i, names, rows, n, kinds):
    """Take good frames from message `i` on, as rows from `n` on; return both where it ends.

    The rows must have room for all messages, and for an eighth of their bytes in centroids.
    """
    fields = np.zeros(2 * len(kinds), np.int64)
    while i < len(messages.start):
        if not _parse(messages, i, kinds, fields):
            break
        size = fields[11]
        n_flux, n_sigma = fields[15], fields[17]
        if fields[13] != size or (n_flux and n_flux != size) or (n_sigma and n_sigma != size):
            break
        if fields[6] < 0:  # a number of 2**63 or more
            break
        low = np.int64(rows.first[n])
        data = messages.data
        bad = _copy_places(data, fields[10], rows.x_px, low, size)
        bad += _copy_places(data, fields[12], rows.y_px, low, size)
        bad += _copy_positive(data, fields[16], n_sigma, rows.sigma_px, low, size)
        if bad:
            break
        _copy_positive(data, fields[14], n_flux, rows.flux, low, size)
        code = _sensor(data, fields[4], fields[5], names, messages.channel[i])
        if code < 0:
            break
        exposure_s = np.uint64(fields[8]).view(np.float64)
        rows.sensor[n], rows.number[n], rows.time_ns[n] = code, fields[6], fields[2]
        rows.exposure_s[n] = exposure_s if 0 < exposure_s < np.inf else 0.0
        rows.has_flux[n], rows.has_sigma[n] = n_flux > 0, n_sigma > 0
        rows.first[n + 1] = low + size
        i += 1
        n += 1
    return i, n


@njit(nogil=True, cache=True)
def _copy_doubles(data, at, n_sent, row):
    """Copy a vector, or NaN where none was sent; return the sum of its squares."""
    total = 0.0
    for k in range(len(row)):
        row[k] = (
            np.uint64(little_endian(data, at + 8 * k, 8)).view(np.float64) if n_sent else np.nan
        )
        total += row[k] ** 2
    return total


@njit(nogil=True, cache=True)
def scan_states(messages, i, names, frames, rows, n, kinds):
    """Take good states from message `i` on, as rows from `n` on; return both where it ends.

    `frames` are the names of reference frames that are known.
    """
    fields = np.zeros(2 * len(kinds), np.int64)
    data = messages.data
    while i < len(messages.start):
        if not _parse(messages, i, kinds, fields):
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
        code = _sensor(data, fields[4], fields[5], names, messages.channel[i])
        if frame < 0 or code < 0:
            break
        rows.sensor[n], rows.frame[n], rows.time_ns[n] = code, frame, fields[2]
        rows.sigma[n, 0] = np.uint64(fields[12]).view(np.float64)
        rows.sigma[n, 1] = np.uint64(fields[16]).view(np.float64)
        i += 1
        n += 1
    return i, n

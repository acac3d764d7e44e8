"""Messages as bytes: where the fields of one lie, in protobuf or in ROS 2 CDR."""

import numpy as np
import numpy.typing as npt

from epipole.io.logs.kernels import kernel
from epipole.io.logs.mcap.byte_loads import load_uint32, load_uint64
from epipole.schemas.messages import CENTROID_FRAME, SENSOR_STATE, MessageType

# How a message is encoded, as the loops here know it.
OTHER, PROTOBUF, CDR = range(3)
# What a field is, by its number; 0 is a field that the message does not have.
UNKNOWN, TIME, TEXT, INTEGER, DOUBLE, FLOATS, DOUBLES = range(7)

MAX_SECONDS = 9_223_372_035  # whole ones that fit into nanoseconds
SECOND_NS = 1_000_000_000


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


# One message's fields: fields[2 f] and fields[2 f + 1] of field number f are
# the time in ns, an integer, a double's bits, or the place and the length of a text or array.


@kernel
def _varint(data, at, end):
    """Return a varint and the place behind it, which is -1 where it is none.

    Of the ten bytes that one may have it takes nine: what needs the tenth is negative, or
    too large for anything here.
    """
    if at < end and data[at] < 0x80:
        return np.uint64(data[at]), at + 1
    value, shift = np.uint64(0), np.uint64(0)
    for k in range(at, min(at + 9, end)):
        value |= np.uint64(data[k] & 0x7F) << shift
        if data[k] < 0x80:
            return value, k + 1
        shift += np.uint64(7)
    return value, -1


@kernel
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


@kernel
def _parse_protobuf(data, at, end, kinds, fields):
    """Fill in the fields of a message; return whether it is one that a scan may take."""
    fields[:] = 0
    seen = np.int64(0)
    while at < end:
        tag, at = _varint(data, at, end)
        if at < 0 or tag > np.uint64(0xFFFFFFFF):
            return False
        number, wire = np.int64(tag >> np.uint64(3)), np.int64(tag & np.uint64(7))
        kind = kinds[number if number < len(kinds) else UNKNOWN]
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
                fields[2 * number] = np.int64(load_uint64(data, at))
            at += width
        else:
            return False
    return True


@kernel
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
            fields[2 * number] = np.int64(load_uint64(data, at))
            at += 8
            continue
        head = np.int64(load_uint32(data, at))
        at += 4
        if kind == TIME:
            if end - at < 4:
                return False
            nanos = np.int64(load_uint32(data, at))
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


@kernel
def parse(data, start, end, encoding, kinds, fields):
    """Return whether a message is well formed and has a time, and fill in its fields."""
    if encoding == PROTOBUF:
        good = _parse_protobuf(data, start, end, kinds, fields)
    elif encoding == CDR:
        good = _parse_cdr(data, start, end, kinds, fields)
    else:
        good = False
    return good and fields[2] > 0

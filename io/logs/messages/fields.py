"""Where the fields of messages lie in the bytes of a chunk, as the compiled scans take it.

An encoding may bring a compiled loop that finds them (`MessageEncoding.locate`). It fills one
row of integers per message:

- column 0 is 1 where the message is well formed and has a valid time, else 0;
- columns ``2 f`` and ``2 f + 1`` belong to the field with number ``f``: the time [ns], the
  integer or the bits of the double; or the place and the length of the text or array. A field
  that was not sent is 0 in both.
"""

import numpy as np
import numpy.typing as npt

from epipole.schemas.logs.messages import DECLARED, FRAME, STATE, MessageType

Integers = npt.NDArray[np.int64]

# The type of a field; UNKNOWN is a field number that the message does not declare.
UNKNOWN, TIME, TEXT, INTEGER, DOUBLE, FLOATS, DOUBLES = range(7)
_SCALARS = {"time": TIME, "string": TEXT, "uint64": INTEGER, "double": DOUBLE}
_ARRAYS = {"float": FLOATS, "double": DOUBLES}


def _field_types(message: MessageType) -> Integers:
    """Return the type of each field of a message, by its number."""
    types = np.full(len(message.members) + 1, UNKNOWN, np.int64)
    for place, member in enumerate(message.members, start=1):
        if member.number != place:
            raise ValueError(f"{message.name}: {member.name} must be field {place}")
        types[place] = _ARRAYS[member.type] if member.repeated else _SCALARS[member.type]
    return types


FIELD_TYPES = {kind: _field_types(DECLARED[kind]) for kind in (FRAME, STATE)}


def no_fields(kind: str, n: int) -> Integers:
    """Return rows of `n` messages in which nothing has been located."""
    return np.zeros((n, 2 * len(FIELD_TYPES[kind])), np.int64)

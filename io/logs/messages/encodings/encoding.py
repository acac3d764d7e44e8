"""What an encoding of messages is: all that reading and writing logs need to know of it."""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from epipole.io.logs.messages.decoded import DecodedMessage

# Fields by name. A calibration has timestamp, frame_id, width, height, distortion_model, D, K,
# R and P; the other kinds have the fields that `epipole.schemas.logs.messages` declares.
Values = Mapping[str, Any]

# What decoders raise where bytes are not a message. Whatever else they raise is a bug.
_INVALID = (
    ValueError,
    TypeError,
    KeyError,
    AttributeError,
    OverflowError,
    RecursionError,
    struct.error,
)


class UndecodableError(Exception):
    """Bytes that are not a message of the kind that their channel declares."""


@dataclass(frozen=True)
class MessageEncoding:
    """One way to write messages as bytes; a kind of message is FRAME, STATE or CALIBRATION.

    `registry` gives it the name that people use, such as ``--encoding ros2``.
    """

    message_encoding: str  # as MCAP names it in channels
    schema_encoding: str  # as MCAP names it in schemas
    schema_names: Mapping[str, tuple[str, ...]]  # by kind; the first is written, all are read
    schema: Callable[[str], bytes]  # the content of the MCAP schema of a kind
    encode: Callable[[str, Values], bytes]  # a message of a kind; `timestamp` is in ns
    decode: Callable[[str, bytes], DecodedMessage]  # the same back; raises one of `_INVALID`
    # A compiled loop (data, start, end, mine, types, fields) that fills `fields` (see
    # `messages.fields`) for the messages that are `mine`. Without one, messages are decoded
    # one at a time, which is slower and gives the same rows.
    locate: Callable[..., None] | None = None
    profile: str = ""  # the MCAP profile of a log that is written

    def decoded(self, kind: str, data: bytes) -> DecodedMessage:
        """Return the message that the bytes are.

        Raises
        ------
        UndecodableError
            Where they are not one; nothing else is raised, whatever the bytes are.
        """
        try:
            return self.decode(kind, data)
        except _INVALID as error:
            raise UndecodableError(f"{type(error).__name__}: {error}") from error

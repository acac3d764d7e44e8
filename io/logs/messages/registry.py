"""All encodings that logs are read and written in. To add one, add its line here."""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from epipole.io.logs.messages.encoding import MessageEncoding

# The name that people give an encoding, and the module with its `ENCODING`. A module is imported
# when it is used: the command line lists the names, and must start at once.
ENCODINGS = {
    "protobuf": "epipole.io.logs.messages.protobuf",
    "json": "epipole.io.logs.messages.json_text",
    "ros2": "epipole.io.logs.messages.ros2_cdr",
}


def encoding_named(name: str) -> "MessageEncoding":
    """Return the encoding with this name.

    Raises
    ------
    ValueError
        Where no encoding has the name.
    """
    if name not in ENCODINGS:
        raise ValueError(f"encoding {name!r}: not one of {', '.join(ENCODINGS)}")
    encoding: MessageEncoding = importlib.import_module(ENCODINGS[name]).ENCODING
    return encoding


def message_encodings() -> "dict[str, MessageEncoding]":
    """Return all encodings by MCAP's name of their messages, such as cdr."""
    return {encoding.message_encoding: encoding for encoding in map(encoding_named, ENCODINGS)}


def kinds_of_schemas() -> dict[str, str]:
    """Return the kind of message (FRAME, STATE or CALIBRATION) by the name of its schema."""
    return {
        name: kind
        for encoding in map(encoding_named, ENCODINGS)
        for kind, names in encoding.schema_names.items()
        for name in names
    }

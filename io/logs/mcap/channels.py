"""The schemas and channels that a log declares, in chunks, outside them and in its summary."""

import struct
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from epipole.io.logs.mcap.compression import ChunkError
from epipole.io.logs.mcap.record_scan import SCHEMA
from epipole.schemas.rejects import Reason


class Channel(NamedTuple):
    """A channel: its topic, the encoding of its messages and the name of their schema."""

    topic: str
    encoding: str
    schema: str


@dataclass
class ChannelTable:
    """Channels by number; a later declaration replaces an earlier one."""

    wanted: frozenset[str]  # names of the schemas whose messages are wanted
    _schemas: dict[int, str] = field(default_factory=dict)
    _channels: dict[int, tuple[str, str, int]] = field(default_factory=dict)
    _known: dict[int, Channel | None] = field(default_factory=dict)

    def __bool__(self) -> bool:
        return bool(self._channels)

    def __contains__(self, number: int) -> bool:
        return number in self._channels

    def declare(self, opcode: int, data: Any, at: int, end: int) -> None:
        """Read the body of a schema or channel record.

        Raises
        ------
        ChunkError
            Where the body is invalid.
        """
        try:
            number = struct.unpack_from("<H", data, at)[0]
            if opcode == SCHEMA:
                self._schemas[number] = string(data, at + 2, end)[0]
            else:
                schema = struct.unpack_from("<H", data, at + 2)[0]
                topic, at = string(data, at + 4, end)
                self._channels[number] = (topic, string(data, at, end)[0], schema)
        except (struct.error, UnicodeDecodeError) as error:
            raise ChunkError(Reason.DAMAGED_CHUNK) from error
        self._known.clear()

    def find(self, number: int) -> Channel | None:
        """Return a channel, or None where it is unknown or its messages are not wanted."""
        if number not in self._known:
            self._known[number] = self._find(number)
        return self._known[number]

    def _find(self, number: int) -> Channel | None:
        if number not in self._channels:
            return None
        topic, encoding, schema = self._channels[number]
        name = self._schemas.get(schema, "")
        return Channel(topic, encoding, name) if name in self.wanted else None


def string(data: Any, at: int, end: int) -> tuple[str, int]:
    """Return an MCAP string and the place after it; raise ChunkError where it passes `end`."""
    (length,) = struct.unpack_from("<I", data, at)
    if at + 4 + length > end:
        raise ChunkError(Reason.DAMAGED_CHUNK)
    return bytes(data[at + 4 : at + 4 + length]).decode(), at + 4 + length

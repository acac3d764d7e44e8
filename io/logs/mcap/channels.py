"""The schemas and channels that a log declares, in chunks, outside them and in its summary."""

import struct
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

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
    """Channels by number, as the records up to here declare them; else as the summary does.

    MCAP wants two declarations of one number to be equal. Where they are not, the later one
    counts, unless it would hide messages that are wanted.
    """

    wanted: frozenset[str]  # names of the schemas whose messages are wanted
    summary: Self | None = None  # what the summary of the log declares
    _schemas: dict[int, str] = field(default_factory=dict)
    _channels: dict[int, tuple[str, str, int]] = field(default_factory=dict)
    _known: dict[int, Channel | None] = field(default_factory=dict)

    def declare(self, opcode: int, data: Any, at: int, end: int) -> None:
        """Read the body of a schema or channel record.

        Raises
        ------
        ChunkError
            Where the body is invalid, or contradicts a declaration of wanted messages.
        """
        try:
            (number,) = struct.unpack_from("<H", data, at)
            if opcode == SCHEMA:
                self._declare_schema(number, string(data, at + 2, end)[0])
            else:
                (schema,) = struct.unpack_from("<H", data, at + 2)
                topic, at = string(data, at + 4, end)
                self._declare_channel(number, topic, string(data, at, end)[0], schema)
        except (struct.error, UnicodeDecodeError) as error:
            raise ChunkError(Reason.DAMAGED_RECORD) from error
        self._known.clear()

    def _declare_schema(self, number: int, name: str) -> None:
        if name not in self.wanted and self._schemas.get(number) in self.wanted:
            raise ChunkError(Reason.DAMAGED_RECORD)
        if number:  # MCAP: a schema of the number zero is to be ignored
            self._schemas[number] = name

    def _declare_channel(self, number: int, topic: str, encoding: str, schema: int) -> None:
        known = self.find(number)
        # The summary is that of the last log in the file: an equal topic says that it is about
        # this channel.
        if (
            known is not None
            and self._name(schema) not in self.wanted
            and (number in self._channels or known[:2] == (topic, encoding))
        ):
            raise ChunkError(Reason.DAMAGED_RECORD)
        self._channels[number] = (topic, encoding, schema)

    def find(self, number: int) -> Channel | None:
        """Return a channel, or None where it is unknown or its messages are not wanted."""
        if number not in self._known:
            self._known[number] = self._find(number)
        return self._known[number]

    def _find(self, number: int) -> Channel | None:
        in_summary = None if self.summary is None else self.summary.find(number)
        if number not in self._channels:
            return in_summary
        topic, encoding, schema = self._channels[number]
        name = self._name(schema)
        return Channel(topic, encoding, name) if name in self.wanted else None

    def _name(self, schema: int) -> str | None:
        """Return the name of a schema, "" for the number zero, and None where it is missing."""
        if schema == 0 or schema in self._schemas:
            return self._schemas.get(schema, "")
        return None if self.summary is None else self.summary._name(schema)

    def missing(self, number: int) -> Reason | None:
        """Return which declaration of a channel is missing; None where it is complete."""
        if number in self._channels:
            schema = self._channels[number][2]
            return Reason.UNKNOWN_SCHEMA if self._name(schema) is None else None
        return Reason.UNKNOWN_CHANNEL if self.summary is None else self.summary.missing(number)

    def forget(self) -> None:
        """Forget what the records up to here declare: another log follows."""
        self._schemas, self._channels, self._known = {}, {}, {}


def string(data: Any, at: int, end: int) -> tuple[str, int]:
    """Return an MCAP string and the place after it; raise ChunkError where it passes `end`."""
    (length,) = struct.unpack_from("<I", data, at)
    if at + 4 + length > end:
        raise ChunkError(Reason.DAMAGED_CHUNK)
    return bytes(data[at + 4 : at + 4 + length]).decode(), at + 4 + length

"""An MCAP file that is written: channels, messages, and its name when it is complete."""

import errno
import os
from pathlib import Path
from types import TracebackType
from typing import NamedTuple, Self

from mcap.writer import CompressionType, Writer

COMPRESSIONS = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}


class Schema(NamedTuple):
    """The schema of a channel's messages, and how they are encoded."""

    name: str
    encoding: str
    data: bytes
    message_encoding: str


class McapFile:
    """Writes one file; a context manager. The file gets its name when it is complete.

    The bytes depend only on the messages and their order. `log_time` and `publish_time` are the
    time of the message.

    Raises
    ------
    ValueError
        Where the compression is unknown.
    OSError
        Where the path is that of a folder, or the file cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        profile: str = "",
        compression: str = "zstd",
        chunk_size: int = 1 << 20,
    ) -> None:
        if compression not in COMPRESSIONS:
            raise ValueError(f"compression {compression!r}: not one of {', '.join(COMPRESSIONS)}")
        self._path = Path(path)
        if self._path.is_dir():  # told before all is written; an empty name is the current folder
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        self._partial = self._path.with_name(self._path.name + ".partial")
        self._file = self._partial.open("wb")
        self._writer = Writer(
            self._file, compression=COMPRESSIONS[compression], chunk_size=chunk_size
        )
        # The default library name has a version in it, which would change the bytes.
        self._writer.start(profile=profile, library="epipole")
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._sequences: dict[int, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._file.close()
            self._partial.unlink(missing_ok=True)

    def close(self) -> None:
        """Write the summary and give the file its name."""
        self._writer.finish()
        self._file.close()
        self._partial.replace(self._path)

    def write(self, topic: str, schema: Schema, time_ns: int, data: bytes) -> None:
        """Write a message; the first of a topic opens its channel."""
        channel = self._channels.get((topic, schema.name)) or self._open(topic, schema)
        sequence = self._sequences[channel]
        self._sequences[channel] = sequence + 1
        self._writer.add_message(channel, time_ns, data, time_ns, sequence & 0xFFFFFFFF)

    def _open(self, topic: str, schema: Schema) -> int:
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        channel = self._writer.register_channel(
            topic, schema.message_encoding, self._schemas[schema.name]
        )
        self._channels[(topic, schema.name)] = channel
        self._sequences[channel] = 0
        return channel

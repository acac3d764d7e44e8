"""The bytes of a log that is in memory and not in a file."""

from epipole.io.logs.mcap.bytes import BlockReader, LogBytes


def log_bytes(data: bytes) -> LogBytes:
    """Return bytes in memory as those of a log; they are fetched in blocks like those of a URL."""
    return LogBytes("memory", len(data), BlockReader(len(data), lambda start, end: data[start:end]))

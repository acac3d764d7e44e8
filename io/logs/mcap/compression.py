"""Chunks of a log to plain bytes, never more bytes than the chunk declares."""

import lz4.frame
import zstandard

from epipole.schemas.rejects import Reason


class ChunkError(Exception):
    """A chunk, or a record in it, that cannot be used."""

    def __init__(self, reason: Reason) -> None:
        super().__init__(reason.value)
        self.reason = reason


def decompress(data: memoryview, compression: str, size: int) -> bytes:
    """Return the records of a chunk, decompressed to `size` bytes.

    Raises
    ------
    ChunkError
        Unknown compression (which names it), corrupt bytes, another size than declared.
    """
    try:
        if compression == "zstd":
            # Checked first: the decoder allocates the size that the frame declares, without limit.
            if zstandard.frame_content_size(data) not in (-1, size):
                raise ChunkError(Reason.WRONG_CHUNK_SIZE)
            records = zstandard.ZstdDecompressor().decompress(data, max_output_size=max(size, 1))
        elif compression == "lz4":
            records = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif compression == "":
            records = bytes(data)
        else:
            raise ChunkError(Reason.UNKNOWN_COMPRESSION)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise ChunkError(Reason.BAD_COMPRESSION) from error
    if len(records) != size:
        raise ChunkError(Reason.WRONG_CHUNK_SIZE)
    return records


def decompress_part(data: memoryview, compression: str, size: int) -> bytes:
    """Return the first bytes of a chunk whose end is missing, at most `size` of them."""
    try:
        if compression == "zstd":
            reader = zstandard.ZstdDecompressor().stream_reader(data)
            pieces = []
            while size > 0 and (piece := reader.read(min(size, 1 << 20))):
                pieces.append(piece)
                size -= len(piece)
            return b"".join(pieces)
        if compression == "lz4":
            return bytes(lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size))
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError):
        return b""
    return bytes(data[:size]) if compression == "" else b""

"""Chunks of a log to plain bytes, never more bytes than the chunk declares."""

import lz4.frame
import zstandard


class ChunkError(Exception):
    """A chunk that does not hold what it says; the message is the reason, in a word."""


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
                raise ChunkError("wrong_chunk_size")
            records = zstandard.ZstdDecompressor().decompress(data, max_output_size=max(size, 1))
        elif compression == "lz4":
            records = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
        elif compression == "":
            records = bytes(data)
        else:
            raise ChunkError("unknown_compression")
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError) as error:
        raise ChunkError("bad_compression") from error
    if len(records) != size:
        raise ChunkError("wrong_chunk_size")
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

"""Images of frames: a spot at each centroid, in a PNG that its own rules can undo."""

import struct
import zlib

import numpy as np
import pytest

from epipole.tasks.overlay.annotations import image_of, png


def decoded(data: bytes) -> np.ndarray:
    """Undo a PNG of one grey channel without filters (ISO/IEC 15948)."""
    at, chunks = 8, {}
    while at < len(data):
        (length,), kind = struct.unpack(">I", data[at : at + 4]), data[at + 4 : at + 8]
        content = data[at + 8 : at + 8 + length]
        (crc,) = struct.unpack(">I", data[at + 8 + length : at + 12 + length])
        assert crc == zlib.crc32(kind + content)
        chunks[kind] = content
        at += 12 + length
    width, height, depth, colour = struct.unpack(">IIBB", chunks[b"IHDR"][:10])
    assert (depth, colour) == (8, 0)
    lines = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), np.uint8).reshape(height, width + 1)
    assert not lines[:, 0].any()
    return lines[:, 1:]


@pytest.mark.parametrize("places", [np.empty((0, 2)), np.array([[5.2, 9.8], [0, 0], [99, 1e9]])])
def test_an_image_has_a_spot_at_each_centroid_that_lies_in_it(places):
    image = image_of((20, 30), places)
    assert image.shape == (20, 30)
    np.testing.assert_array_equal(decoded(png(image)), image)
    if len(places):
        assert image[10, 5] == image[0, 0] == 255
        assert (image > 0).sum() == 9 + 4
    else:
        assert not image.any()

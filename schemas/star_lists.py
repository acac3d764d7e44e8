"""Catalogues: the table of stars with its label, and the elements of a satellite."""

from collections.abc import Iterable
from typing import NamedTuple

import pyarrow as pa

from epipole.schemas.columns import column, schema

# Stars: `epipole catalog build` writes the table, and a run reads it.

_F64 = pa.float64()

STAR_CATALOGUE = schema(
    "star_catalogue",
    "One row per star, at the catalogue's epoch.",
    [
        column("star_id", pa.int64(), doc="Number in the catalogue."),
        column("ra_deg", _F64, unit="deg", frame="ICRS", doc="Right ascension at the epoch."),
        column("dec_deg", _F64, unit="deg", frame="ICRS", doc="Declination at the epoch."),
        column("pm_ra_mas_yr", _F64, unit="mas/yr", doc="Proper motion times cos(dec)."),
        column("pm_dec_mas_yr", _F64, unit="mas/yr", doc="Proper motion."),
        column("parallax_mas", _F64, unit="mas", doc="Parallax; 0 where unknown."),
        column("sigma_mas", _F64, unit="mas", doc="1-sigma per axis of the position at the epoch."),
        column("pm_sigma_mas_yr", _F64, unit="mas/yr", doc="1-sigma per axis of the motion."),
        column("magnitude", _F64, unit="mag", doc="V magnitude."),
        column("variable", pa.bool_(), doc="Flagged as variable by the catalogue."),
    ],
)

# 1-sigma per axis of an unknown motion, which is taken as zero [mas/yr]. Of Hipparcos' stars of V 7
# to 8 (nearly all stars of that magnitude), 84 % move by less than 68 mas per year.
UNKNOWN_MOTION_MAS_YR = 35.0


class CatalogueLabel(NamedTuple):
    """Name, epoch and source of a catalogue.

    name : the catalogue that the star ids belong to, such as "hipparcos"
    epoch : Julian year of all positions
    source : the data that it was made from
    """

    name: str
    epoch: float
    source: str


def labelled(stars: pa.Table, label: CatalogueLabel) -> pa.Table:
    """Return the catalogue with its label in the schema's metadata, as Parquet keeps it."""
    words = {"catalogue": label.name, "epoch": repr(label.epoch), "source": label.source}
    return _with_words(stars, words)


def label_of(stars: pa.Schema) -> CatalogueLabel:
    """Return the label of a catalogue's schema.

    Raises
    ------
    ValueError
        Where it has no label.
    """
    words = stars.metadata or {}
    try:
        return CatalogueLabel(
            words[b"catalogue"].decode(), float(words[b"epoch"]), words[b"source"].decode()
        )
    except KeyError as error:
        raise ValueError(f"no {error.args[0].decode()} in the metadata") from None


def with_catalogue(stars: pa.Table, catalogue: pa.Schema) -> pa.Table:
    """Return a table of identified stars with the name and source of their catalogue."""
    label = label_of(catalogue)
    words = {"catalogue": label.name, "catalogue_source": label.source}
    return _with_words(stars, words)


def _with_words(stars: pa.Table, words: dict[str, str]) -> pa.Table:
    encoded = {key.encode(): value.encode() for key, value in words.items()}
    return stars.replace_schema_metadata((stars.schema.metadata or {}) | encoded)


# Satellites: the mean elements of a published set, for SGP4.


class ElementSet(NamedTuple):
    """The mean elements of one satellite at their epoch, of WGS 72."""

    name: str  # empty if missing
    number: int  # of the satellite catalogue
    epoch_ns: int  # UTC since 1970
    # The arguments of `sgp4init`, in its order: days since 1949 December 31 0h UTC, 1 / Earth
    # radii, rad/min^2 (half the first derivative), rad/min^3 (a sixth of the second), and angles
    # in rad; the mean motion in rad/min.
    elements: tuple[float, ...]
    cospar_id: str = ""  # such as 1998-067A; empty if missing

    @property
    def label(self) -> str:
        """Return its name and number, for messages."""
        return f"{self.name} ({self.number})" if self.name else str(self.number)

    def is_called(self, name: str) -> bool:
        """Return whether this is its name, in any case, or its catalogue number."""
        return name.strip().upper() in (self.name.upper(), str(self.number))


def nearest_sets(sets: Iterable[ElementSet], time_ns: int) -> list[ElementSet]:
    """Return one set for each object: that whose epoch is nearest to a time."""
    nearest: dict[int, ElementSet] = {}
    for each in sets:
        other = nearest.get(each.number)
        if other is None or abs(each.epoch_ns - time_ns) < abs(other.epoch_ns - time_ns):
            nearest[each.number] = each
    return list(nearest.values())

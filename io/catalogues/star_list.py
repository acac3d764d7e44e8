"""Star lists of users (CSV or Parquet) as a catalogue. Every column and row is checked."""

import hashlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq

from epipole.io.paths import refuse_device
from epipole.schemas.arrays import Array, Flags, Integers
from epipole.schemas.bridge import table
from epipole.schemas.errors import CatalogueError
from epipole.schemas.star_lists import (
    STAR_CATALOGUE,
    UNKNOWN_MOTION_MAS_YR,
    CatalogueLabel,
    labelled,
)

REQUIRED = ("star_id", "ra_deg", "dec_deg", "magnitude")
MOTION = ("pm_ra_mas_yr", "pm_dec_mas_yr")
MAX_NAMED = 5  # invalid rows that a message names
LARGEST_FLOAT_ID = 2.0**53  # above it floating-point numbers skip whole ones
EPOCHS = (1850.0, 2150.0)

# Least and greatest value. The fastest star moves 10.4" per year, and the nearest has a parallax of
# 0.77". Measured parallaxes may be negative.
_BOUNDS = {
    "ra_deg": (0.0, 360.0),
    "dec_deg": (-90.0, 90.0),
    "magnitude": (-30.0, 40.0),
    "pm_ra_mas_yr": (-11_000.0, 11_000.0),
    "pm_dec_mas_yr": (-11_000.0, 11_000.0),
    "parallax_mas": (-1000.0, 1000.0),
    "sigma_mas": (0.0, 60_000.0),
    "pm_sigma_mas_yr": (0.0, 11_000.0),
}
_TRUTH = {"true": True, "1": True, "false": False, "0": False}
# Fewer stars than this may all lie where degrees look like radians or hours.
_MANY = 100


class StarList(NamedTuple):
    """A user's stars as a labelled table STAR_CATALOGUE, and the columns that are ignored."""

    stars: pa.Table
    ignored: list[str]


def read_star_list(path: Path, epoch: float | None = None, name: str | None = None) -> StarList:
    """Return a user's stars.

    The columns star_id, ra_deg, dec_deg and magnitude are required. The other columns of
    STAR_CATALOGUE may be missing or empty. A missing motion is taken as zero, with the sigma
    UNKNOWN_MOTION_MAS_YR.

    Parameters
    ----------
    path
        CSV with a header line, or Parquet (suffix .parquet).
    epoch
        Julian year of the positions. Default: `epoch` in the metadata of the Parquet file.
    name
        Name of the catalogue. Default: the name of the file.

    Raises
    ------
    CatalogueError
        Names the missing columns, or the invalid rows and their columns.
    """
    try:
        refuse_device(path)
    except OSError as error:
        raise CatalogueError(f"{path}: {error.strerror}; give a file") from error
    read = _read_parquet(path) if path.suffix == ".parquet" else _read_csv(path)
    missing = [column for column in REQUIRED if column not in read.columns]
    if missing:
        raise CatalogueError(
            f"{path}: no column {', '.join(missing)}; it has {', '.join(read.columns)}; the "
            f"columns are {', '.join(STAR_CATALOGUE.names)}"
        )
    if not read.height:
        raise CatalogueError(f"{path}: no stars in this file")
    faults = _Faults(path, read)
    columns = _columns(read, faults)
    faults.raise_if_any()
    _check_units(path, columns)
    epoch = _epoch(path, epoch)
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    label = CatalogueLabel(name or path.stem, epoch, f"{path.name} (sha256 {digest})")
    ignored = [column for column in read.columns if column not in STAR_CATALOGUE.names]
    return StarList(labelled(table(STAR_CATALOGUE, columns), label), ignored)


class _Faults:
    """Invalid rows, named by row (from 1, without the header) and column."""

    def __init__(self, path: Path, read: pl.DataFrame) -> None:
        self.path, self.read = path, read
        self._found: dict[int, str] = {}

    def add(self, bad: Flags, column: str, why: str) -> None:
        for row in np.flatnonzero(bad).tolist():
            value = self.read[column][row]
            what = f"{column} is empty" if value is None else f"{column} = {value}"
            self._found.setdefault(row, f"row {row + 1}: {what}, {why}")

    def raise_if_any(self) -> None:
        if not self._found:
            return
        first = [self._found[row] for row in sorted(self._found)[:MAX_NAMED]]
        more = len(self._found) - len(first)
        raise CatalogueError(
            f"{self.path}: {len(self._found)} of {self.read.height} rows are invalid; "
            "correct or remove them: " + "; ".join(first) + (f"; and {more} more" if more else "")
        )


def _read_csv(path: Path) -> pl.DataFrame:
    try:
        return pl.read_csv(path, infer_schema=False, null_values=["", "null", "NULL", "NaN", "nan"])
    except (OSError, pl.exceptions.PolarsError) as error:
        raise CatalogueError(f"{path}: cannot be read as CSV ({_first_line(error)})") from error


def _read_parquet(path: Path) -> pl.DataFrame:
    try:
        fields = pq.read_schema(path)
        read = pl.read_parquet(path, use_pyarrow=False, hive_partitioning=False)
    except (OSError, pa.ArrowException, pl.exceptions.PolarsError) as error:
        raise CatalogueError(f"{path}: cannot be read as Parquet ({_first_line(error)})") from error
    for ours in STAR_CATALOGUE:
        if ours.name not in fields.names:
            continue
        unit = (fields.field(ours.name).metadata or {}).get(b"unit", b"").decode()
        wanted = (ours.metadata or {}).get(b"unit", b"").decode()
        if unit and unit != wanted:
            raise CatalogueError(f"{path}: column {ours.name} is in {unit}; it must be in {wanted}")
    return read


def _first_line(error: Exception) -> str:
    return str(error).strip().splitlines()[0]


def _columns(read: pl.DataFrame, faults: _Faults) -> dict[str, npt.NDArray[Any]]:
    columns: dict[str, npt.NDArray[Any]] = {"star_id": _identities(read, faults)}
    for name, bounds in _BOUNDS.items():
        columns[name] = _numbers(read, name, bounds, faults)
    half = np.isnan(columns[MOTION[0]]) != np.isnan(columns[MOTION[1]])
    if half.any():
        faults.add(
            half,
            next(m for m in MOTION if m in read.columns),
            "the other component of the motion is missing",
        )
    unknown = np.isnan(columns["pm_sigma_mas_yr"]) & np.isnan(columns[MOTION[0]])
    columns["pm_sigma_mas_yr"][unknown] = UNKNOWN_MOTION_MAS_YR
    for name in (*MOTION, "parallax_mas", "sigma_mas", "pm_sigma_mas_yr"):
        columns[name] = np.nan_to_num(columns[name])
    columns["ra_deg"][columns["ra_deg"] == 360.0] = 0.0
    columns["variable"] = _flags(read, faults)
    return columns


def _identities(read: pl.DataFrame, faults: _Faults) -> Integers:
    """Return the ids of the stars. Each must be a whole number, and occur once."""
    given = read["star_id"]
    if given.dtype.is_float():
        large = given.is_finite() & (given.abs() > LARGEST_FLOAT_ID)
        why = "too large for floating-point numbers: write whole numbers"
        faults.add(large.fill_null(False).to_numpy(), "star_id", why)
        given = given.set(given.floor() != given, None)  # the cast would cut them
    numbers = given.cast(pl.Int64, strict=False)
    missing = numbers.is_null().to_numpy()
    faults.add(missing, "star_id", "not a whole number")
    star_id = numbers.fill_null(0).to_numpy().astype(np.int64)
    twice = numbers.is_duplicated().to_numpy() & ~missing
    faults.add(twice, "star_id", "another row has the same number")
    return star_id


def _numbers(read: pl.DataFrame, name: str, bounds: tuple[float, float], faults: _Faults) -> Array:
    """Return a column of numbers, NaN where a value or the column is missing."""
    if name not in read.columns:
        return np.full(read.height, np.nan)
    values = read[name].cast(pl.Float64, strict=False)
    empty = read[name].is_null().to_numpy()
    numbers = values.fill_null(np.nan).to_numpy().copy()
    if read[name].dtype.is_float():
        empty = empty | np.isnan(numbers)  # Parquet files of other tools use NaN for it
    faults.add(np.isnan(numbers) & ~empty, name, "not a number")
    if name in REQUIRED:
        faults.add(empty, name, "a value is required")
    low, high = bounds
    faults.add((numbers < low) | (numbers > high), name, f"not within {low:g} to {high:g}")
    return numbers


def _flags(read: pl.DataFrame, faults: _Faults) -> Flags:
    if "variable" not in read.columns:
        return np.zeros(read.height, bool)
    texts = read["variable"].cast(pl.String, strict=False).str.to_lowercase()
    flags = texts.replace_strict(_TRUTH, default=None, return_dtype=pl.Boolean)
    faults.add((flags.is_null() & texts.is_not_null()).to_numpy(), "variable", "not true or false")
    return flags.fill_null(False).to_numpy().astype(bool)


def _check_units(path: Path, columns: dict[str, npt.NDArray[Any]]) -> None:
    """Raise where the stars fill the sky, but in another unit than degrees."""
    ra, dec = np.asarray(columns["ra_deg"], float), np.asarray(columns["dec_deg"], float)
    if len(ra) < _MANY:
        return
    if ra.max() <= 2 * np.pi and ra.max() > 5 and np.abs(dec).max() <= np.pi / 2:
        raise CatalogueError(
            f"{path}: ra_deg ends at {ra.max():.3f} and dec_deg lies within "
            f"{np.abs(dec).max():.3f}, as radians do; give degrees"
        )
    if 20 < ra.max() <= 24 and np.ptp(dec) > 90:
        raise CatalogueError(f"{path}: ra_deg ends at {ra.max():.3f}, as hours do; give degrees")


def _epoch(path: Path, epoch: float | None) -> float:
    if epoch is None and path.suffix == ".parquet":
        text = (pq.read_schema(path).metadata or {}).get(b"epoch")
        try:
            epoch = None if text is None else float(text)
        except ValueError:
            raise CatalogueError(f"{path}: epoch {text!r} in its metadata is not a year") from None
    if epoch is None:
        raise CatalogueError(
            f"{path}: the epoch of its positions is unknown; give --epoch, such as 2016.0"
        )
    if not EPOCHS[0] <= epoch <= EPOCHS[1]:
        raise CatalogueError(f"{path}: epoch {epoch:g} is not a Julian year such as 2016.0")
    return epoch

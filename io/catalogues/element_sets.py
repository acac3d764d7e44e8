"""Catalogues of known objects: files of two-line elements, or of CCSDS OMM in JSON, CSV or XML."""

import csv
import hashlib
import json
import math
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from sgp4 import omm
from sgp4.api import WGS72, Satrec
from sgp4.io import compute_checksum

from epipole.io.paths import known_as, open_remote
from epipole.schemas.errors import CatalogueError, LogError
from epipole.schemas.star_lists import ElementSet

# Records of a file.

_UNIX_EPOCH_JD = 2440587.5
_SGP4_EPOCH_JD = 2433281.5  # 1949 December 31, 0h
_DAY_NS = 86_400_000_000_000
_LINE_LENGTH = 69
_LARGEST_NUMBER = 999_999_999  # of a satellite: messages have nine digits
_LAST_NS = 2**63 - 1  # a time of tables
_TYPE = 62  # the column of line 1 with the ephemeris type
# A line of elements however much of it was cut off, and not a name: it has the satellite's number.
_CUT = re.compile(r"1 [ 0-9A-Z][ 0-9]{4}([A-Z ]|$)|2 [ 0-9A-Z][ 0-9]{4}( |$)")
# Elements for other theories, such as SGP4-XP, mean another orbit.
_THEORIES = ("SGP4", "SGP", "SGP/SGP4")
_XP = "4"  # the ephemeris type of SGP4-XP
# What messages of elements for SGP4 have (CCSDS 502.0-B-3); else they mean another orbit or time.
_OF_SGP4 = {"CENTER_NAME": "EARTH", "REF_FRAME": "TEME", "TIME_SYSTEM": "UTC"}
_OF_XP = "its ephemeris type is 4 (SGP4-XP), expected SGP4"
_MEAN = ("bstar", "ndot", "nddot", "ecco", "argpo", "inclo", "mo", "no_kozai", "nodeo")


class Fault(NamedTuple):
    """A record that is not a valid element set: where it is in the file, and what is wrong."""

    where: str
    what: str

    def __str__(self) -> str:
        """Return both, as a message says it."""
        return f"{self.where}: {self.what}"


def parse_element_sets(data: bytes) -> tuple[list[ElementSet], list[Fault]]:
    """Return the element sets of a file, in its order, and the invalid records.

    The content shows which form it has: lines of two-line elements with or without names before
    them ("0 " before a name is left away, lines that begin with # are comments), or OMM with the
    keywords of CCSDS 502.0-B, as CelesTrak and Space-Track publish them.

    Raises
    ------
    CatalogueError
        Where it is neither valid JSON nor valid XML.
    """
    text = data.decode("utf-8-sig", "replace")  # a damaged letter costs its record at most
    found = list(_parsed(text, data))
    return (
        [each for each in found if isinstance(each, ElementSet)],
        [each for each in found if isinstance(each, Fault)],
    )


def _parsed(text: str, data: bytes) -> Iterator[ElementSet | Fault]:
    start = text.lstrip()[:1]
    if start in ("[", "{"):
        return _messages(_json_messages(text))
    if start == "<":
        return _messages(_xml_messages(data))
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if lines and "MEAN_MOTION" in lines[0]:
        return _messages(_csv_messages(lines))
    return _two_line_sets(text)


def _two_line_sets(text: str) -> Iterator[ElementSet | Fault]:
    title, first, number = "", None, 0
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if not line or line.startswith("#"):
            continue
        is_elements = len(line) >= _LINE_LENGTH - 1 or _CUT.match(line) is not None
        if first is not None and line.startswith("2 "):
            yield _two_line_set(title, first, (number, line))
            title, first = "", None
            continue
        if first is not None:
            what = f"expected line 2 of the elements, found {line[:20]!r}"
            yield Fault(f"line {number}", what)
            title, first = "", None
        if line.startswith("1 ") and is_elements:
            first = number, line
        elif line.startswith("2 ") and is_elements:
            yield Fault(f"line {number}", "line 2 of the elements without line 1")
            title = ""
        else:
            title = line.removeprefix("0 ").strip()
    if first is not None:
        yield Fault(f"line {number}", "the file ends after line 1 of an element set")


def _two_line_set(title: str, *lines: tuple[int, str]) -> ElementSet | Fault:
    """Return the element set of two lines, each with its number in the file."""
    for number, line in lines:
        if (what := _fault_of(line)) is not None:
            return Fault(f"line {number}", what)
    first, second = (line[:_LINE_LENGTH] for _, line in lines)
    if first[_TYPE] == _XP:
        return Fault(f"line {lines[0][0]}", _OF_XP)
    try:
        satellite = Satrec.twoline2rv(first, second, WGS72)
        if first[2:7] != second[2:7]:
            raise ValueError(f"of satellite {second[2:7]}, line 1 is of {first[2:7]}")
        return _element_set(title, int(satellite.satnum), _cospar_id(first[9:17]), satellite)
    except ValueError as error:
        return Fault(f"line {lines[1][0]}", str(error))


def _fault_of(line: str) -> str | None:
    """Return what is wrong with a line; what follows its checksum does not count."""
    body = line[:_LINE_LENGTH]
    if len(body) < _LINE_LENGTH:
        return f"{len(body)} characters; elements have {_LINE_LENGTH}"
    if not body.isascii():
        return "has other characters than ASCII"
    if body[-1] != str(compute_checksum(body)):
        return f"its checksum is {body[-1]}, expected {compute_checksum(body)}"
    return None


def _cospar_id(designator: str) -> str:
    """Return the international designator of two-line elements (98067A) as 1998-067A."""
    year, rest = designator[:2], designator[2:].strip()
    if not (year.isdigit() and rest):
        return ""
    return f"{'19' if int(year) >= 57 else '20'}{year}-{rest}"


def _json_messages(text: str) -> list[Mapping[str, Any]]:
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise CatalogueError(f"not JSON: {error}") from error
    return found if isinstance(found, list) else [found]


def _xml_messages(data: bytes) -> list[Mapping[str, Any]]:
    try:
        root = ET.fromstring(data)
    except (ET.ParseError, LookupError, ValueError) as error:
        raise CatalogueError(f"not an OMM in XML: {error}") from error
    return [_segment_fields(segment) for segment in root.iterfind(".//segment")]


def _segment_fields(segment: ET.Element) -> dict[str, Any]:
    """Return the keywords of a segment, of as many of its parts as it has."""
    parts = ("metadata", "data/meanElements", "data/tleParameters")
    return {field.tag: field.text for part in parts for field in segment.iterfind(f"{part}/*")}


def _csv_messages(lines: Iterable[str]) -> Iterator[Mapping[str, Any]]:
    try:
        yield from csv.DictReader(lines, skipinitialspace=True)
    except csv.Error as error:
        raise CatalogueError(f"not an OMM in CSV: {error}") from error


def _messages(messages: Iterable[Mapping[str, Any]]) -> Iterator[ElementSet | Fault]:
    for number, fields in enumerate(messages, start=1):
        satellite = Satrec()
        try:
            text = _texts(fields)
            satellite_number = int(text["NORAD_CAT_ID"])
            omm.initialize(satellite, _with_defaults(text))
            yield _element_set(
                text.get("OBJECT_NAME", ""), satellite_number, text.get("OBJECT_ID", ""), satellite
            )
        except (KeyError, ValueError, AttributeError, OverflowError, TypeError) as error:
            what = f"{error.args[0]} is missing" if isinstance(error, KeyError) else str(error)
            yield Fault(f"message {number}", f"not an OMM: {what}")


def _texts(fields: Any) -> dict[str, str]:
    if not isinstance(fields, Mapping):
        raise ValueError("no keywords")
    return {
        str(key): str(value).encode("utf-8", "replace").decode().strip()  # half a surrogate pair
        for key, value in fields.items()
        if value is not None
    }


def _with_defaults(fields: dict[str, str]) -> dict[str, str]:
    """Return the fields as sgp4 reads them; those that the orbit does not need have one value."""
    unused = {  # sgp4 wants them, and refuses some values
        "CLASSIFICATION_TYPE": "U", "OBJECT_ID": "", "EPHEMERIS_TYPE": "0",
        "ELEMENT_SET_NO": "0", "REV_AT_EPOCH": "0",
    }  # fmt: skip
    if fields.get("MEAN_ELEMENT_THEORY", "SGP4") not in _THEORIES:
        raise ValueError(f"MEAN_ELEMENT_THEORY is {fields['MEAN_ELEMENT_THEORY']}, expected SGP4")
    if fields.get("EPHEMERIS_TYPE") == _XP:
        raise ValueError(_OF_XP)
    for name, expected in _OF_SGP4.items():
        if (given := fields.get(name) or expected).upper() != expected:
            raise ValueError(f"{name} is {given}, expected {expected}")
    # sgp4 refuses the numbers above 339999, which two-line elements cannot hold.
    changed = {"EPOCH": _epoch(fields["EPOCH"]), "NORAD_CAT_ID": "0"}
    return fields | unused | changed


def _epoch(text: str) -> str:
    """Return an epoch with one to six decimals of a second, as sgp4 reads it."""
    whole, _, decimals = text.removesuffix("Z").partition(".")
    # Below a microsecond it is a centimetre. What else stands there, such as a zone, is refused.
    return f"{whole}.{decimals[:6] if decimals.isdigit() else decimals or 0}"


def _element_set(title: str, number: int, cospar_id: str, satellite: Any) -> ElementSet:
    day, part = satellite.jdsatepoch, satellite.jdsatepochF
    elements = (day - _SGP4_EPOCH_JD + part, *(float(getattr(satellite, n)) for n in _MEAN))
    is_orbit = satellite.no_kozai > 0.0 and 0.0 <= satellite.ecco < 1.0
    if not (is_orbit and all(map(math.isfinite, elements))):
        raise ValueError("mean motion, eccentricity, epoch or an angle is out of bounds")
    epoch_ns = round((day - _UNIX_EPOCH_JD) * _DAY_NS) + round(part * _DAY_NS)
    if abs(epoch_ns) > _LAST_NS:
        raise ValueError("its epoch is out of bounds")
    if not 0 <= number <= _LARGEST_NUMBER:
        raise ValueError(f"the number of the satellite is {number}, expected nine digits at most")
    return ElementSet(title, number, epoch_ns, elements, cospar_id)


# The file, and its digest.

ADVICE = "give two-line elements, or OMM in CSV, JSON or XML"


class KnownObjects(NamedTuple):
    """The element sets of a file, in its order, and its invalid records."""

    file: str  # its name, without folders
    sha256: str
    sets: list[ElementSet]
    faults: list[Fault]


def read_known_objects(where: str) -> KnownObjects:
    """Return the catalogue of known objects that a path or a URL names.

    Raises
    ------
    CatalogueError
        Where it is missing, cannot be read or has no element set.
    """
    where = known_as(where)
    data = _bytes_of(where)
    try:
        sets, faults = parse_element_sets(data)
    except CatalogueError as error:
        raise CatalogueError(f"{where}: {error}; {ADVICE}") from error
    if not sets:
        first = f" ({faults[0]})" if faults else ""
        raise CatalogueError(f"{where}: has no element sets{first}; {ADVICE}")
    return KnownObjects(Path(where).name, hashlib.sha256(data).hexdigest(), sets, faults)


def _bytes_of(where: str) -> bytes:
    if "://" in where:
        try:
            size, read, _ = open_remote(where)
            return read(0, size)
        except LogError as error:
            raise CatalogueError(str(error)) from error
    path = Path(where)
    if not path.is_file():
        what = "not a regular file" if path.exists() else "no such file"
        raise CatalogueError(f"{where}: {what}; {ADVICE}")
    try:
        return path.read_bytes()
    except OSError as error:
        raise CatalogueError(f"{where}: cannot be read: {error.strerror}; {ADVICE}") from error

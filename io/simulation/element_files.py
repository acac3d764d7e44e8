"""Files of published element sets: two-line elements, and CCSDS OMM in JSON, CSV or XML."""

import csv
import json
import os
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from sgp4 import omm
from sgp4.api import WGS72, Satrec
from sgp4.io import compute_checksum

from epipole.schemas.errors import SceneError
from epipole.schemas.simulation.element_set import ElementSet

_BUILT_IN = Path(__file__).parent / "built_in"
_UNIX_EPOCH_JD = 2440587.5
_SGP4_EPOCH_JD = 2433281.5  # 1949 December 31, 0h
_DAY_NS = 86_400_000_000_000
_LINE_LENGTH = 69


def built_in_element_files() -> list[str]:
    """Return the names of the files of element sets that come with the package."""
    return sorted(path.name for path in _BUILT_IN.glob("*.tle"))


def read_element_sets(path: str | os.PathLike[str]) -> list[ElementSet]:
    """Return the element sets of a file, in its order.

    The file is of the package (such as ``real_orbits.tle``) or on the disk. Its content shows
    which form it has: lines of two-line elements with or without names before them ("0 " before
    a name is left away, lines that begin with # are comments), or OMM with the keywords of CCSDS
    502.0-B, as CelesTrak and Space-Track publish them.

    Raises
    ------
    SceneError
        Where the file is missing, has no element sets, or one of them is invalid.
    """
    name = os.fspath(path)
    where = _BUILT_IN / name if name in built_in_element_files() else Path(name)
    try:
        text = where.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{name}: cannot be read as element sets: {error}") from error
    found = list(_parsed(text, where, name))
    if not found:
        raise SceneError(f"{name}: has no element sets; give two-line elements or OMM")
    return found


def _parsed(text: str, where: Path, name: str) -> Iterator[ElementSet]:
    start = text.lstrip()[:1]
    if start in ("[", "{"):
        return _messages(_json_messages(text, name), name)
    if start == "<":
        return _messages(_xml_messages(where, name), name)
    if "MEAN_MOTION" in text.lstrip().partition("\n")[0]:
        return _messages(csv.DictReader(text.lstrip().splitlines()), name)
    return _two_line_sets(text, name)


def _two_line_sets(text: str, name: str) -> Iterator[ElementSet]:
    title, first = "", None
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.rstrip()
        where = f"{name}, line {number}"
        if not line or line.startswith("#"):
            continue
        if first is not None:
            if not line.startswith("2 "):
                raise SceneError(f"{where}: expected line 2 of the elements, found {line[:20]!r}")
            yield _two_line_set(title, first, _checked(line, where), where)
            title, first = "", None
        elif line.startswith("1 ") and len(line) >= _LINE_LENGTH - 1:
            first = _checked(line, where)
        elif line.startswith("2 ") and len(line) >= _LINE_LENGTH - 1:
            raise SceneError(f"{where}: line 2 of the elements without line 1")
        else:
            title = line.removeprefix("0 ").strip()
    if first is not None:
        raise SceneError(f"{name}: ends after line 1 of an element set")


def _checked(line: str, where: str) -> str:
    """Return the line without what follows its checksum; raise where the sum is wrong."""
    body = line[:_LINE_LENGTH]
    if len(body) < _LINE_LENGTH:
        raise SceneError(f"{where}: {len(body)} characters; elements have {_LINE_LENGTH}")
    if body[-1] != str(compute_checksum(body)):
        raise SceneError(f"{where}: its checksum is {body[-1]}, expected {compute_checksum(body)}")
    return body


def _two_line_set(title: str, first: str, second: str, where: str) -> ElementSet:
    try:
        satellite = Satrec.twoline2rv(first, second, WGS72)
    except ValueError as error:
        raise SceneError(f"{where}: not an element set: {error}") from error
    if first[2:7] != second[2:7]:
        raise SceneError(f"{where}: of satellite {second[2:7]}, line 1 is of {first[2:7]}")
    return _element_set(title, int(satellite.satnum), satellite)


def _json_messages(text: str, name: str) -> list[Mapping[str, Any]]:
    try:
        found = json.loads(text)
    except ValueError as error:
        raise SceneError(f"{name}: not JSON: {error}") from error
    return found if isinstance(found, list) else [found]


def _xml_messages(where: Path, name: str) -> list[Mapping[str, Any]]:
    try:
        with where.open("rb") as file:
            return list(omm.parse_xml(file))
    except (ET.ParseError, AttributeError, TypeError) as error:
        raise SceneError(f"{name}: not an OMM in XML: {error}") from error


def _messages(messages: Iterable[Mapping[str, Any]], name: str) -> Iterator[ElementSet]:
    for number, fields in enumerate(messages, start=1):
        satellite = Satrec()
        try:
            text = {key: str(value).strip() for key, value in fields.items() if value is not None}
            satellite_number = int(text["NORAD_CAT_ID"])
            omm.initialize(satellite, _with_defaults(text))
        except (KeyError, ValueError, AttributeError) as error:
            what = f"{error.args[0]} is missing" if isinstance(error, KeyError) else str(error)
            raise SceneError(f"{name}, message {number}: not an OMM: {what}") from error
        yield _element_set(text.get("OBJECT_NAME", ""), satellite_number, satellite)


def _with_defaults(fields: dict[str, str]) -> dict[str, str]:
    """Return the fields with those that the orbit does not need, and an epoch as sgp4 reads it."""
    unused = {
        "CLASSIFICATION_TYPE": "U", "OBJECT_ID": "", "EPHEMERIS_TYPE": "0",
        "ELEMENT_SET_NO": "0", "REV_AT_EPOCH": "0",
    }  # fmt: skip
    if not fields.get("MEAN_ELEMENT_THEORY", "SGP4").startswith("SGP"):
        raise ValueError(f"MEAN_ELEMENT_THEORY is {fields['MEAN_ELEMENT_THEORY']}, expected SGP4")
    epoch = fields["EPOCH"].removesuffix("Z")
    # sgp4 refuses the numbers above 339999, which two-line elements cannot hold.
    changed = {"EPOCH": epoch if "." in epoch else f"{epoch}.0", "NORAD_CAT_ID": "0"}
    return unused | fields | changed


def _element_set(title: str, number: int, satellite: Any) -> ElementSet:
    day, part = satellite.jdsatepoch, satellite.jdsatepochF
    epoch_ns = round((day - _UNIX_EPOCH_JD) * _DAY_NS) + round(part * _DAY_NS)
    names = ("bstar", "ndot", "nddot", "ecco", "argpo", "inclo", "mo", "no_kozai", "nodeo")
    elements = (day - _SGP4_EPOCH_JD + part, *(float(getattr(satellite, n)) for n in names))
    return ElementSet(title, number, epoch_ns, elements)

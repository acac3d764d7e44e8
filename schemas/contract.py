"""What programs that read a dataset rely on: columns, keys, and links between tables.

docs/tables.json has it for machines. Nights of all versions stand in one dataset, so what is there
may gain columns, but not change without another version of the table. A column that is added may be
null, or says what it is in nights that were published before (`before`): they are read so.
"""

import json
from collections.abc import Iterator
from typing import Any, NamedTuple

import pyarrow as pa

from epipole.schemas.tables import TABLES

FRAME = ("sensor_id", "frame_number")
DETECTION = (*FRAME, "centroid")
PAIR = ("epoch", *(f"{name}_{k}" for k in (1, 2) for name in DETECTION))


class Keys(NamedTuple):
    """What names a row of a table, and which rows of other tables it belongs to.

    columns : no two rows of a night have the same; () where rows have no name
    links : columns of the table, and of the table that they lead to. Null leads nowhere; what is
        followed over midnight may lead to the night beside.
    """

    columns: tuple[str, ...]
    links: tuple[tuple[tuple[str, ...], str, tuple[str, ...]], ...] = ()


def _same(table: str, *columns: str) -> tuple[tuple[str, ...], str, tuple[str, ...]]:
    return (columns, table, columns)


_FRAMES, _OBJECTS = _same("frames", *FRAME), _same("objects", "object_id")
_TRACKLETS = _same("tracklets", "tracklet_id")

KEYS = {
    "frames": Keys(FRAME),
    "stars": Keys(DETECTION, (_FRAMES,)),
    "detections": Keys(DETECTION, (_FRAMES, _TRACKLETS)),
    "tracklets": Keys(("tracklet_id",), (_OBJECTS,)),
    "epochs": Keys(("epoch", "sensor_id"), (_FRAMES,)),
    "associations": Keys(
        ("epoch", "object_id", "sensor_id"),
        (_same("epochs", "epoch", "sensor_id"), _FRAMES, _OBJECTS, _TRACKLETS),
    ),
    "positions": Keys(("epoch", "object_id"), (_OBJECTS,)),
    "observations": Keys(DETECTION, (_FRAMES, _OBJECTS, _TRACKLETS)),
    "states": Keys(("epoch", "object_id"), (_OBJECTS,)),
    "orbits": Keys(("object_id",), (_OBJECTS,)),
    "objects": Keys(("object_id",)),
    "identifications": Keys(("object_id", "tracklet_id"), (_OBJECTS, _TRACKLETS)),
    "calibrations": Keys(("sensor_id",)),
    "sensor_errors": Keys(("sensor_id",)),
    "checks": Keys(("sensor_id", "check")),
    "pairs": Keys(
        PAIR, tuple((tuple(f"{name}_{k}" for name in FRAME), "frames", FRAME) for k in (1, 2))
    ),
    "sources": Keys(("name", "sha256")),
    "nights": Keys(()),
    "rejects": Keys((), (_TRACKLETS,)),
}


def contract() -> dict[str, Any]:
    """Return the tables as JSON takes them: version, meaning, key, links and columns of each."""
    return {name: _table(name, schema) for name, schema in TABLES.items()}


def _table(name: str, schema: pa.Schema) -> dict[str, Any]:
    keys = KEYS[name]
    return {
        "version": schema.metadata[b"version"].decode(),
        "meaning": schema.metadata[b"doc"].decode(),
        "key": list(keys.columns),
        "links": [
            {"columns": list(here), "table": other, "to": list(to)}
            for here, other, to in keys.links
        ],
        "columns": {field.name: _column(field) for field in schema},
    }


def _column(field: pa.Field) -> dict[str, Any]:
    about = {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}
    before = {"before": json.loads(about["before"])} if "before" in about else {}
    return {
        "type": str(field.type),
        "null": field.nullable,
        "unit": about.get("unit", ""),
        "frame": about.get("frame", ""),
        "meaning": about["doc"],
        **before,
    }


def breaks(before: dict[str, Any], after: dict[str, Any]) -> Iterator[str]:
    """Yield what readers of a table would stumble over after a change, a sentence each.

    Parameters
    ----------
    before, after
        A table of `contract`. With another version, all may have changed.
    """
    if before["version"] != after["version"]:
        return
    for name, column in before["columns"].items():
        now = after["columns"].get(name)
        if now is None:
            yield f"{name}: the column is gone"
            continue
        for what in ("type", "unit", "frame"):
            if column[what] != now[what]:
                yield f"{name}: {what} was {column[what] or 'none'}, is {now[what] or 'none'}"
        if now["null"] and not column["null"]:
            yield f"{name}: may be null, which it was not"
    for name, column in after["columns"].items():
        if name not in before["columns"] and not column["null"] and "before" not in column:
            yield f"{name}: is new, may not be null, and does not say what it is in earlier nights"
    if before["key"] != after["key"]:
        yield f"key: was {', '.join(before['key'])}, is {', '.join(after['key'])}"
    for link in before["links"]:
        if link not in after["links"]:
            yield f"link: {', '.join(link['columns'])} does not lead to {link['table']} any more"

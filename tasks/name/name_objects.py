"""Name objects: the objects of the spans become the objects of the night."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from epipole.io.work.parts import Parts
from epipole.schemas.spans import Span
from epipole.tasks.algorithms.orbits.object_identity import ObjectRegistry


def name_objects(solved: Parts, spans: Sequence[Span]) -> dict[str, dict[str, str]]:
    """Return, for each span's folder, what its objects are called in the night.

    An object is named by the UTC date of the span in which it is first seen and its number in
    the night, and keeps its name while a track of it goes on.

    Parameters
    ----------
    solved
        Parts by `solve_span`.
    spans
        Those that have one, in order.
    """
    registry = ObjectRegistry()
    track_number: dict[str, int] = {}
    ids: dict[int, str] = {}
    out = {}
    for span in spans:
        tracks = _tracks(solved.read(span, "object_tracks"), track_number)
        numbers = registry.name_groups(list(tracks.values()))
        date = str(np.datetime64(span.start_ns, "ns").astype("datetime64[D]")).replace("-", "")
        for number in numbers:
            ids.setdefault(number, f"{date}-{number + 1:05d}")
        out[span.folder] = {old: ids[number] for old, number in zip(tracks, numbers, strict=True)}
    return out


def _tracks(rows: pa.Table, known: dict[str, int]) -> dict[str, np.ndarray]:
    """Return the tracks of each object of a span, as numbers; objects in order of their names."""
    found: dict[str, list[int]] = {}
    for old, track in zip(*(rows[n].to_pylist() for n in rows.column_names), strict=True):
        found.setdefault(old, []).append(known.setdefault(track, len(known)))
    return {old: np.array(found[old], np.int64) for old in sorted(found)}

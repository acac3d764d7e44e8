"""Name objects: one id in the night for each object of the spans."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from epipole.io.work.parts import Parts
from epipole.schemas.spans import Span
from epipole.tasks.algorithms.orbits.object_identity import ObjectRegistry


def name_objects(solved: Parts, spans: Sequence[Span]) -> dict[str, dict[str, str]]:
    """Return the names in the night of each span's objects, by the folder of the span.

    A name is the UTC date of the first span with the object, and the object's number in the night.
    An object keeps its name as long as one of its tracks continues.

    Parameters
    ----------
    solved
        The parts of `solve_span`.
    spans
        The spans that have a part, in order.
    """
    registry = ObjectRegistry()
    track_number: dict[str, int] = {}
    ids: dict[int, str] = {}
    names = {}
    for span in spans:
        tracks = _tracks(solved.read(span, "object_tracks"), track_number)
        numbers = registry.name_groups(list(tracks.values()))
        date = str(np.datetime64(span.start_ns, "ns").astype("datetime64[D]")).replace("-", "")
        for number in numbers:
            ids.setdefault(number, f"{date}-{number + 1:05d}")
        names[span.folder] = {old: ids[number] for old, number in zip(tracks, numbers, strict=True)}
    return names


def _tracks(rows: pa.Table, known: dict[str, int]) -> dict[str, np.ndarray]:
    """Return the numbers of each object's tracks; objects sorted by their names in the span."""
    tracks: dict[str, list[int]] = {}
    for old, track in zip(*(rows[n].to_pylist() for n in rows.column_names), strict=True):
        tracks.setdefault(old, []).append(known.setdefault(track, len(known)))
    return {old: np.array(tracks[old], np.int64) for old in sorted(tracks)}

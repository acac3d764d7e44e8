"""Tracklets on the sky: some of each outcome, as lines."""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl

from epipole.io.datasets.night_reader import NightReader
from epipole.schemas.rejects import Outcome

Array = npt.NDArray[np.float64]

MOST_DRAWN = 240
POINTS = 6  # of a line, about


class SkyTrack(NamedTuple):
    """A tracklet: its outcome, and (n, 2) right ascension and declination [deg] along it."""

    outcome: str
    radec_deg: Array


class SkyTracks(NamedTuple):
    """Tracklets of a night; `counts` are of all of them, by outcome, and `lines` of some."""

    counts: dict[str, int]
    lines: list[SkyTrack]


def read_sky_tracks(night: NightReader) -> SkyTracks | None:
    """Return the tracklets of a night; None: it has none. Of many, every so manieth is drawn."""
    columns = ["tracklet_id", "outcome", "n_detections"]
    drawn: list[pl.DataFrame] = [night.empty("tracklets", columns)]
    counts: dict[str, int] = {}
    step = max(-(-night.count("tracklets") // MOST_DRAWN), 1)
    passed = 0
    for rows in night.pieces("tracklets", columns):
        for outcome, count in rows["outcome"].value_counts().iter_rows():
            counts[outcome] = counts.get(outcome, 0) + count
        drawn.append(rows.gather_every(step, -passed % step))
        passed += len(rows)
    if not counts:
        return None
    chosen = pl.concat(drawn)
    places = _places(night, chosen)
    lines = [
        SkyTrack(outcome, places[name]) for name, outcome, _ in chosen.iter_rows() if name in places
    ]
    order = [outcome.value for outcome in Outcome]
    known = {outcome: counts[outcome] for outcome in order if outcome in counts}
    return SkyTracks(known, lines)


def _places(night: NightReader, chosen: pl.DataFrame) -> dict[str, Array]:
    names = chosen["tracklet_id"].implode()
    found: dict[str, list[Array]] = {}
    columns = ["tracklet_id", "ra_deg", "dec_deg"]
    for rows in night.pieces("detections", columns):
        own = rows.filter(pl.col("tracklet_id").is_in(names)).drop_nulls()
        for (name,), of_track in own.group_by("tracklet_id", maintain_order=True):
            found.setdefault(str(name), []).append(of_track.select(columns[1:]).to_numpy())
    return {name: _thinned(np.concatenate(pieces)) for name, pieces in found.items()}


def _thinned(places: Array) -> Array:
    at = np.unique(np.linspace(0, len(places) - 1, POINTS).astype(int))
    return places[at]

"""Observations: the sightings of all tracklets, each with its object where there is one.

A tracklet is an unbroken run of detections of one object. So its detections before and after the
epochs at which other sensors saw the object are observations of it too. Near an epoch at which the
position was solved without the tracklet, they are not. A tracklet that no other sensor saw has
observations without an object, unless an orbit joins it to one.
"""

from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from typing import Literal

import polars as pl
import pyarrow as pa

from epipole.io.work.parts import read_part
from epipole.io.work.work_layout import NOTHING_ADDED, AddedErrors
from epipole.schemas.bridge import concat, from_polars, to_polars
from epipole.schemas.observation import FITTED_FIELDS
from epipole.schemas.tables import OBSERVATIONS
from epipole.schemas.work_tables import SIGHTINGS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.common.sightings import MARK
from epipole.tasks.publish.hot_tracklets import hot_tracklets
from epipole.tasks.publish.night_parts import NightParts, in_slices

_KEY = ["sensor_id", "frame_number", "centroid"]
_NOT_FITTED = {
    field.name: pl.lit(None, pl.Boolean if field.type == pa.bool_() else pl.Float64)
    for field in FITTED_FIELDS
}


def observations(parts: NightParts) -> Iterator[pa.Table]:
    """Yield OBSERVATIONS, sorted by time, sensor and centroid, some time of a span each."""
    runs = object_runs(parts)
    hot = pl.Series(hot_tracklets(parts)["tracklet_id"])
    for span in parts.spans:
        viewed_parts = [of.viewed for of in parts.sensors if of.viewed.holds(span)]
        tables = [partial(viewed.read, span, "sightings") for viewed in viewed_parts]
        errors = to_polars(parts.solved.shared_errors(span))
        for rows in in_slices(tables, span, "time"):
            seen = with_objects(to_polars(concat(SIGHTINGS, rows)), runs)
            seen = seen.filter(pl.col("tracklet_id").is_in(hot.implode()).not_())
            seen = with_links(published(seen), parts)
            seen = with_shared_errors(seen, errors, parts.solved.added).with_columns(**_NOT_FITTED)
            yield from_polars(OBSERVATIONS, seen)


def object_runs(parts: NightParts) -> pl.DataFrame:
    """Return the epochs of each tracklet that follow each other and are equal.

    Returns
    -------
    polars.DataFrame
        tracklet_id, object_id, used, first and last (epochs), sorted by first.
    """
    columns = ["epoch", "object_id", *_KEY, "tracklet_id", "used"]
    spans = []
    for span in parts.all_spans:
        names = parts.names.get(span.folder, {})
        pieces = parts.solved.pieces(span) if parts.solved.holds(span) else []
        tables = (to_polars(read_part(piece, "associations", columns)) for piece in pieces)
        spans.append(runs_of_views(_named(rows, names) for rows in tables))
    return pl.concat([runs_of_views([]), *spans]).sort("first", "tracklet_id", "object_id")


def _named(views: pl.DataFrame, names: Mapping[str, str]) -> pl.DataFrame:
    """Return the views of named objects: others have a position only before or after the night."""
    named = pl.col("object_id").replace_strict(names, default=None, return_dtype=pl.String)
    return views.with_columns(named).drop_nulls("object_id")


def runs_of_views(pieces: Iterable[pl.DataFrame]) -> pl.DataFrame:
    """Return the runs of ASSOCIATIONS, as `object_runs` does; lone detections by their mark.

    Of each piece only codes of its texts stay in memory, a tenth of it.
    """
    tracklets, objects = _Codes(), _Codes()
    coded = [_coded(views, tracklets, objects) for views in pieces]
    views = pl.concat([pl.DataFrame(schema=_CODED), *coded])
    views = views.sort("tracklet_id", "epoch", "object_id")
    member = pl.struct("tracklet_id", "object_id", "used")
    runs = views.group_by(member.rle_id().alias("run"), maintain_order=True).agg(
        pl.col("tracklet_id", "object_id", "used").first(),
        pl.col("epoch").first().alias("first"),
        pl.col("epoch").last().alias("last"),
    )
    return runs.drop("run").with_columns(
        tracklet_id=tracklets.texts(runs["tracklet_id"]), object_id=objects.texts(runs["object_id"])
    )


_CODED: dict[str, pl.DataType | type[pl.DataType]] = {
    "tracklet_id": pl.UInt32, "object_id": pl.UInt32, "used": pl.Boolean,
    "epoch": pl.Datetime("ns", "UTC"),
}  # fmt: skip


class _Codes:
    """Whole numbers for texts, from 0, in the order of their first appearance."""

    def __init__(self) -> None:
        self._code: dict[str, int] = {}

    def of(self, texts: pl.Series) -> pl.Series:
        code = self._code
        known = {
            text: code.setdefault(text, len(code)) for text in texts.unique(maintain_order=True)
        }
        codes = texts.replace_strict(known, return_dtype=pl.UInt32) if known else texts
        return codes.cast(pl.UInt32)

    def texts(self, codes: pl.Series) -> pl.Series:
        return pl.Series(codes.name, list(self._code), pl.String).gather(codes)


def _coded(views: pl.DataFrame, tracklets: _Codes, objects: _Codes) -> pl.DataFrame:
    lone = pl.format("{}{}-{}-{}", pl.lit(MARK), *_KEY)
    views = views.with_columns(tracklet_id=pl.coalesce("tracklet_id", lone))
    columns = [
        tracklets.of(views["tracklet_id"]), objects.of(views["object_id"]), views["used"],
        views["epoch"],
    ]  # fmt: skip
    return pl.DataFrame(columns)


def with_objects(sightings: pl.DataFrame, runs: pl.DataFrame) -> pl.DataFrame:
    """Return the sightings with the object that their tracklet shows at the nearest epoch.

    Null without one, and where the object's position was solved without the tracklet.
    """
    rows = sightings.sort("time", maintain_order=True).with_row_index("row")
    before, after = _asof(rows, runs, "first", "backward"), _asof(rows, runs, "last", "forward")
    # Within a run both are the same run; between two runs the nearer one counts.
    to_last = (before["time"] - before["last"]).dt.total_nanoseconds()
    to_first = (after["first"] - after["time"]).dt.total_nanoseconds()
    is_before = to_first.is_null() | (to_last.is_not_null() & (to_last <= to_first))
    name, used = (
        before[column].zip_with(is_before.fill_null(True), after[column])
        for column in ("object_id", "used")
    )
    shown = name.zip_with(used.fill_null(False), pl.Series([None], dtype=pl.String))
    return rows.with_columns(object_id=shown).sort("row")


def published(sightings: pl.DataFrame) -> pl.DataFrame:
    """Return the sightings that `observations` has: a lone detection only if it shows an object."""
    lone = pl.col("tracklet_id").str.starts_with(MARK)
    kept = sightings.filter(lone.not_() | pl.col("object_id").is_not_null())
    return kept.with_columns(tracklet_id=pl.when(lone.not_()).then("tracklet_id"))


def with_links(rows: pl.DataFrame, parts: NightParts) -> pl.DataFrame:
    """Return rows of tracklets; those that an orbit joins to an object have its id."""
    linked = to_polars(parts.linked).rename({"object_id": "linked_id"})
    found = rows.select("tracklet_id").join(
        linked, on="tracklet_id", how="left", maintain_order="left"
    )
    return rows.with_columns(object_id=pl.coalesce("object_id", found["linked_id"]))


def longest_object(runs: pl.DataFrame) -> pl.DataFrame:
    """Return the object of each tracklet that shows one: the one that it shows for longest.

    Returns
    -------
    polars.DataFrame
        tracklet_id, object_id.
    """
    lasted = (pl.col("last") - pl.col("first")).dt.total_nanoseconds()
    return (
        runs.filter("used")
        .group_by("tracklet_id", "object_id", maintain_order=True)
        .agg(lasted.sum())
        .sort("last", descending=True, maintain_order=True)
        .unique("tracklet_id", keep="first", maintain_order=True)
        .select("tracklet_id", "object_id")
    )


def _asof(
    rows: pl.DataFrame, runs: pl.DataFrame, edge: str, strategy: Literal["backward", "forward"]
) -> pl.DataFrame:
    """Return the run of each row's tracklet whose edge is the nearest in this direction."""
    return rows.join_asof(
        runs.sort(edge), left_on="time", right_on=edge, by="tracklet_id", strategy=strategy,
        check_sortedness=False,
    )  # fmt: skip


def with_shared_errors(
    rows: pl.DataFrame, errors: pl.DataFrame, added: AddedErrors
) -> pl.DataFrame:
    """Return the rows; shared errors that are larger than stated are as large as they are."""
    if added != NOTHING_ADDED:
        rows = _with_added_errors(rows, added)
    factors = rows.select("sensor_id").join(
        errors, on="sensor_id", how="left", maintain_order="left"
    )
    return rows.with_columns(
        pl.col("bias_sigma_arcsec") * factors["direction"].fill_null(1.0).sqrt(),
        pl.col("position_sigma_km") * factors["position"].fill_null(1.0).sqrt(),
    )


def _with_added_errors(rows: pl.DataFrame, added: AddedErrors) -> pl.DataFrame:
    sensors = rows.select(pl.col("sensor_id").unique())
    faults = [added.of(name) for name in sensors["sensor_id"]]
    more = sensors.with_columns(
        km=pl.Series([fault.km for fault in faults], dtype=pl.Float64),
        arcsec=pl.Series([fault.rad / ARCSEC for fault in faults], dtype=pl.Float64),
    )
    of_rows = rows.select("sensor_id").join(more, on="sensor_id", maintain_order="left")
    return rows.with_columns(
        position_sigma_km=(pl.col("position_sigma_km") ** 2 + of_rows["km"] ** 2).sqrt(),
        bias_sigma_arcsec=(pl.col("bias_sigma_arcsec") ** 2 + of_rows["arcsec"] ** 2).sqrt(),
    )

"""Join tracklets: those of one sensor's spans become the tracklets and tracks of its night.

Detections near the border of two spans are followed in both. Tracklets of the two spans that share
detections there are one tracklet.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl

from epipole.io.work.parts import (
    NIGHT_TRACKLETS,
    SPAN_NAMES,
    Parts,
    is_written,
    read_part,
    write_part,
)
from epipole.schemas.bridge import from_polars, to_polars
from epipole.schemas.spans import DAY_NS, Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import HOT_SUSPECTS, TRACKLET_NAMES, TRACKLET_RUNS
from epipole.tasks.algorithms.tracking.linking.chains import chain_heads
from epipole.tasks.common.batches import Batch
from epipole.tasks.common.stage_tasks import stage_task

KEY = ["frame_number", "centroid"]


class SensorToJoin(NamedTuple):
    """A sensor's tracklets: its parts of `track_spans`, their spans in order, and where parts go.

    These are `SPAN_NAMES` of each span, and `NIGHT_TRACKLETS`.
    """

    sensor: Sensor
    spans: Sequence[Span]
    tracked: Parts
    parts: Parts

    def __str__(self) -> str:
        """Return the sensor's id."""
        return f"{self.sensor}"


@stage_task(Stage.TRACK, "{sensors} all spans")
def join_tracklets(sensors: Batch[SensorToJoin], night: str) -> int:
    """Name the tracklets of some sensors for a night, a UTC date, unless the parts exist.

    Returns
    -------
    int
        Number of tracklets.

    Notes
    -----
    A detection belongs to the tracklet that it has in the span it lies in. A tracklet keeps its
    number of the span before, if the two share more detections than either shares with another.
    Which tracklet it continues is taken from the span in which it begins. A tracklet that crosses
    midnight is one in each night: its id, times and counts are of its detections in the night.
    """
    count = 0
    for each in sensors:
        if not is_written(each.parts.of_night()):
            _join(each.sensor, each.tracked, each.spans, night, each.parts)
        count += read_part(each.parts.of_night(), "tracklets").num_rows
    return count


def _join(sensor: Sensor, tracked: Parts, spans: Sequence[Span], night: str, parts: Parts) -> None:
    count = 0
    before: pl.DataFrame | None = None  # the span before: its detections' tracklet numbers
    summed, linked = [], []
    for k, span in enumerate(spans):
        part = tracked.of(span)
        rows = _tracked(part).with_columns(
            inside=pl.col("time_ns").is_between(*span, closed="left")
        )
        known = _shared(before, rows)  # the span before may not be the neighbour
        numbers = _numbered(rows, known, count)
        count = max([count, *(numbers["number"] + 1).to_list()])
        rows = rows.join(numbers, on="span_name")
        linked.append(_links(part, numbers).with_columns(span=pl.lit(k, pl.Int64)))
        summed.append(_summed(rows.filter("inside"), part).with_columns(span=pl.lit(k, pl.Int64)))
        before = rows.select(*KEY, "number")
    of_night = _of_night(pl.concat(summed), spans, night)
    _write(spans, parts, pl.concat(linked), of_night, sensor.sensor_id)


def _of_night(summed: pl.DataFrame, spans: Sequence[Span], night: str) -> pl.DataFrame:
    """Return the rows without those outside the night, where the tracklet has others."""
    start_ns = int(np.datetime64(night, "ns").astype(np.int64))
    of_day = [k for k, span in enumerate(spans) if start_ns <= span.start_ns < start_ns + DAY_NS]
    inside = pl.col("span").is_in(of_day)
    return summed.filter(inside | ~inside.any().over("number"))


def _tracked(part: Path) -> pl.DataFrame:
    """Return a row per detection of a tracklet, in order of time."""
    rows = read_part(part, "detections", [*KEY, "time", "tracklet_id"])
    rows = rows.filter(rows["tracklet_id"].is_valid())
    return (
        to_polars(rows)
        .with_columns(time_ns=pl.col("time").cast(pl.Int64))
        .rename({"tracklet_id": "span_name"})
        .drop("time")
        .sort("time_ns", *KEY)
    )


def _shared(before: pl.DataFrame | None, rows: pl.DataFrame) -> pl.DataFrame:
    """Return the numbers of tracklets that share most detections with one of the span before."""
    if before is None:
        return pl.DataFrame(schema={"span_name": pl.String, "number": pl.Int64})
    both = (
        rows.join(before, on=KEY)
        .group_by("span_name", "number")
        .len()
        .sort(["len", "number", "span_name"], descending=[True, False, False])
    )
    names: dict[str, int] = {}
    taken: set[int] = set()
    for name, number, _ in both.iter_rows():
        if name not in names and number not in taken:
            names[name] = number
            taken.add(number)
    return pl.DataFrame(
        {"span_name": list(names), "number": list(names.values())},
        schema={"span_name": pl.String, "number": pl.Int64},
    )


def _numbered(rows: pl.DataFrame, known: pl.DataFrame, count: int) -> pl.DataFrame:
    """Return each tracklet's number in the night; new tracklets get numbers from `count` on."""
    names = rows.select(pl.col("span_name").unique(maintain_order=True))
    numbers = names.join(known, on="span_name", how="left", maintain_order="left")
    new = numbers["number"].is_null()
    fresh = pl.Series(np.cumsum(new.to_numpy()) - 1 + count, dtype=pl.Int64)
    return numbers.with_columns(number=pl.when(new).then(fresh).otherwise(pl.col("number")))


def _links(part: Path, numbers: pl.DataFrame) -> pl.DataFrame:
    """Return which tracklet each tracklet of a span continues, and the chi-square of the link."""
    rows = to_polars(
        read_part(part, "tracklets", ["tracklet_id", "track_id", "start_time", "link_chi2"])
    ).rename({"tracklet_id": "span_name"})
    rows = rows.join(numbers, on="span_name").sort("track_id", "start_time", "span_name")
    return rows.select(
        "span_name",
        "number",
        "link_chi2",
        after=pl.col("number").shift(1).over("track_id"),
    )


def _summed(rows: pl.DataFrame, part: Path) -> pl.DataFrame:
    """Return a row per tracklet of a span: its detections inside the span, rate and residual, and
    whether it may be a hot pixel."""
    motions = to_polars(
        read_part(part, "tracklets", ["tracklet_id", "rate_arcsec_s", "residual_px"])
    )
    suspects = to_polars(read_part(part, "suspects"))["tracklet_id"]
    return (
        rows.group_by("number", "span_name")
        .agg(
            start_ns=pl.col("time_ns").first(),
            end_ns=pl.col("time_ns").last(),
            n=pl.len(),
            frame_number=pl.col("frame_number").first(),
            centroid=pl.col("centroid").first(),
        )
        .join(motions.rename({"tracklet_id": "span_name"}), on="span_name")
        .with_columns(suspect=pl.col("span_name").is_in(suspects.to_list()))
        .sort("number")
    )


def _write(
    spans: Sequence[Span], parts: Parts, linked: pl.DataFrame, summed: pl.DataFrame, sensor_id: str
) -> None:
    night = (
        summed.sort("number", "span")
        .group_by("number", maintain_order=True)
        .agg(
            pl.col("frame_number", "centroid", "span", "start_ns").first(),
            pl.col("end_ns").last(),
            n_detections=pl.col("n").sum(),
            rate_arcsec_s=(pl.col("rate_arcsec_s") * pl.col("n")).sum() / pl.col("n").sum(),
            residual_px=(
                (pl.col("residual_px") ** 2 * pl.col("n")).sum() / pl.col("n").sum()
            ).sqrt(),
            suspect=(pl.col("suspect") * pl.col("n")).sum() / pl.col("n").sum() > 0.5,
        )
        .join(linked.drop("span_name"), on=["number", "span"], how="left")
        .sort("start_ns", "frame_number", "centroid")
        .with_columns(
            tracklet_id=pl.format("{}-{}-{}", pl.lit(sensor_id), "frame_number", "centroid")
        )
    )
    before, chi2 = _before(night)
    ids = night["tracklet_id"].to_numpy()
    heads = ids[chain_heads(before)] if len(ids) else ids
    night = night.with_columns(
        track_id=pl.Series(heads, dtype=pl.String), link_chi2=pl.Series(chi2, dtype=pl.Float64)
    )
    names = linked.join(night.select("number", "tracklet_id", "track_id"), on="number")
    for k, span in enumerate(spans):
        of_span = names.filter(span=k).sort("span_name")
        write_part(parts.of(span), SPAN_NAMES, {"names": from_polars(TRACKLET_NAMES, of_span)})
    night = night.rename({"start_ns": "start_time", "end_ns": "end_time"}).with_columns(
        sensor_id=pl.lit(sensor_id)
    )
    night = night.sort("start_time", "tracklet_id")
    tables = {
        "tracklets": from_polars(TRACKLET_RUNS, night),
        "suspects": from_polars(HOT_SUSPECTS, night.filter("suspect")),
    }
    write_part(parts.of_night(), NIGHT_TRACKLETS, tables)


def _before(night: pl.DataFrame) -> tuple[np.ndarray, list[float | None]]:
    """Return the row that each tracklet continues (-1: none), and the chi-square of the link.

    In two spans, different tracklets may continue the same one. The link with the smaller
    chi-square is kept.
    """
    row_of = {number: row for row, number in enumerate(night["number"])}
    before = np.full(len(night), -1)
    chi2: list[float | None] = [None] * len(night)
    taken: set[int] = set()
    candidates = [
        (link_chi2, row, row_of[after])
        for row, (link_chi2, after) in enumerate(night.select("link_chi2", "after").iter_rows())
        if link_chi2 is not None and after in row_of
    ]
    end_ns, start_ns = night["end_ns"].to_list(), night["start_ns"].to_list()
    for link_chi2, row, after in sorted(candidates):
        if after not in taken and end_ns[after] < start_ns[row]:
            taken.add(after)
            before[row], chi2[row] = after, link_chi2
    return before, chi2

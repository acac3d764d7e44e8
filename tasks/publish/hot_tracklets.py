"""Hot tracklets: those that may be hot pixels, judged by what became of them.

A sensor that follows an object may hold it on the middle of a pixel, as a hot pixel stands. What
another sensor sees as well is an object. What none sees is a hot pixel: its detections say so, and
`rejects` has a row for it.
"""

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.parts import read_part
from epipole.schemas.bridge import array, concat, conform, to_polars
from epipole.schemas.rejects import Outcome, Reason, reject_rows
from epipole.schemas.tables import DETECTIONS, REJECTS
from epipole.schemas.work_tables import HOT_SUSPECTS, JUDGED_TRACKLETS, TRACKLET_RUNS
from epipole.tasks.publish.night_parts import NightParts
from epipole.tasks.solve.associate_block import best_outcomes

UNCONFIRMED = (Outcome.UNDECIDED, Outcome.SEEN_BY_ONE, Outcome.NOT_COMPARED)


def tracklets_of_run(parts: NightParts) -> pa.Table:
    """Return JUDGED_TRACKLETS of the run: each has its outcome over all spans."""
    runs = [read_part(sensor.names.of_night(), "tracklets") for sensor in parts.sensors]
    tracklets = concat(TRACKLET_RUNS, runs)
    outcomes = best_outcomes(
        rows
        for span in parts.all_spans
        for rows in (
            *parts.solved.of_blocks(span, "outcomes"), *parts.solved.read(span, "outcomes"),
        )
    )  # fmt: skip
    row = pc.index_in(tracklets["tracklet_id"], outcomes["tracklet_id"].combine_chunks())
    outcome = pc.coalesce(outcomes["outcome"].take(row), Outcome.NOT_COMPARED.value)
    return conform(JUDGED_TRACKLETS, tracklets.append_column("outcome", outcome))


def hot_tracklets(parts: NightParts) -> pa.Table:
    """Return the rows of JUDGED_TRACKLETS of the run that are hot pixels."""
    suspects = _suspects(parts)
    if not suspects.num_rows:
        return JUDGED_TRACKLETS.empty_table()
    return _hot(tracklets_of_run(parts), suspects)


def confirmed_tracklets(parts: NightParts) -> pa.Table:
    """Return JUDGED_TRACKLETS of the run without those that are hot pixels."""
    tracklets = tracklets_of_run(parts)
    hot = _hot(tracklets, _suspects(parts))["tracklet_id"]
    return tracklets.filter(pc.invert(pc.is_in(tracklets["tracklet_id"], hot)))


def with_hot_pixels(detections: pa.Table, hot: pa.ChunkedArray | None) -> pa.Table:
    """Return DETECTIONS; those of hot tracklets are of kind ``hot_pixel``, of no tracklet."""
    if hot is None or not len(hot):
        return detections
    is_hot = pc.fill_null(pc.is_in(detections["tracklet_id"], hot), False)
    for name, value in (("kind", "hot_pixel"), ("tracklet_id", None), ("track_id", None)):
        at = detections.schema.get_field_index(name)
        changed = pc.if_else(is_hot, pa.scalar(value, pa.string()), detections[name])
        detections = detections.set_column(at, DETECTIONS.field(name), changed)
    return detections


def hot_pixel_rejects(parts: NightParts) -> pa.Table:
    """Return a row of `rejects` per hot tracklet, and one per sensor for its other hot pixels."""
    hot = hot_tracklets(parts)
    rows = [
        reject_rows(
            Reason.HOT_PIXEL,
            time=hot["start_time"],
            count=hot["n_detections"].cast(pa.int64()),
            sensor_id=hot["sensor_id"],
            tracklet_id=hot["tracklet_id"],
        )
    ]
    for sensor in parts.sensors:
        columns = ["time", "sensor_id", "kind"]
        found = [
            span.of(sensor.tracked.read(span, "detections", columns), "time").filter(
                pc.field("kind") == "hot_pixel"
            )
            for span in parts.spans
            if sensor.tracked.holds(span)
        ]
        seen = pa.concat_tables(found) if found else DETECTIONS.empty_table()
        if seen.num_rows:
            rows.append(
                reject_rows(
                    Reason.HOT_PIXEL,
                    time=array(seen, "time").min(keepdims=True),
                    count=[seen.num_rows],
                    sensor_id=[seen["sensor_id"][0].as_py()],
                )
            )
    return concat(REJECTS, rows)


def _suspects(parts: NightParts) -> pa.Table:
    tables = [read_part(sensor.names.of_night(), "suspects") for sensor in parts.sensors]
    return concat(HOT_SUSPECTS, tables)


def _hot(tracklets: pa.Table, suspects: pa.Table) -> pa.Table:
    """Return the tracklets that are hot pixels: all tracklets of their tracks are suspects, and
    none was seen by another sensor."""
    rows = to_polars(tracklets.select(["tracklet_id", "track_id", "outcome"])).with_columns(
        hot=pl.col("tracklet_id").is_in(suspects["tracklet_id"].to_pylist())
        & pl.col("outcome").is_in([outcome.value for outcome in UNCONFIRMED])
    )
    hot = rows.select(pl.col("hot").all().over("track_id"))["hot"]
    return tracklets.filter(pa.array(hot.to_list(), pa.bool_()))

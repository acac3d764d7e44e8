"""Write tables: the parts of a night's spans, joined to the tables of a dataset."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.datasets.night_tables import write_table
from epipole.io.datasets.rows_by_night import in_order, rows_of_night
from epipole.io.work.parts import Parts, read_part
from epipole.schemas.bridge import array, concat, conform, from_polars, table, to_polars
from epipole.schemas.rejects import Outcome, Reason, Trait, reject_rows
from epipole.schemas.settings import Settings, TableSettings
from epipole.schemas.spans import DAY_NS, Span, spans_between
from epipole.schemas.stages import Stage
from epipole.schemas.tables import ASSOCIATIONS, REJECTS, SOURCES, TABLES, TRACKLETS
from epipole.schemas.work_tables import ATTRIBUTABLES, SOLUTIONS, LogSource
from epipole.tasks.common.sightings import with_lone_objects, with_names
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.publish.hot_tracklets import (
    confirmed_tracklets,
    hot_pixel_rejects,
    hot_tracklets,
    with_hot_pixels,
)
from epipole.tasks.publish.night_parts import NightParts, in_slices
from epipole.tasks.publish.observed_objects import (
    longest_object,
    object_runs,
    observations,
    with_links,
    with_shared_errors,
)
from epipole.tasks.solve.align_epochs import SERVED_NS

# These tables may not fit in memory as a whole: they are written in slices of time.
BY_SENSOR = ("frames", "stars", "detections")
BY_SPAN = ("epochs", "associations", "positions", "pairs", "states")
WHOLE = ("tracklets", "calibrations", "checks", "sources", "rejects")
# The tables of one task each; stars are most of the work.
SHARES = (("stars",), ("detections",), ("observations",), ("frames",), (*BY_SPAN, *WHOLE))
DECIDED_BY_ORBITS = (Reason.AMBIGUOUS, Reason.UNDECIDED)


@stage_task(Stage.PUBLISH, "{tables[0]} of {parts.night}")
def write_tables(tables: Sequence[str], folder: Path, parts: NightParts) -> None:
    """Write tables of a night, each sorted by time, from the parts of its spans.

    Parameters
    ----------
    tables
        Names of the tables: one of `SHARES`.
    folder
        Where the night's tables go.
    """
    for name in tables:
        rows: Iterator[pa.Table]
        if name in BY_SENSOR:
            rows = _of_sensors(name, parts)
        elif name == "observations":
            rows = observations(parts)
        elif name in BY_SPAN:
            rows = _of_spans(name, parts)
        else:
            rows = iter([_of_night(name, parts)])
        write_table(folder, name, rows)


def _of_night(name: str, parts: NightParts) -> pa.Table:
    if name == "tracklets":
        rows = tracklets_of_night(parts)
    elif name == "rejects":
        rows = counted([parts.whole[name], *_rejects(parts), hot_pixel_rejects(parts)])
    else:
        rows = parts.whole[name]
    return in_order(rows_of_night(name, rows, parts.night))


def tracklets_of_night(parts: NightParts) -> pa.Table:
    """Return TRACKLETS of the run: with their objects, and with their attributables."""
    rows = to_polars(confirmed_tracklets(parts))
    sensors = rows.select("tracklet_id", "sensor_id")
    found = pl.concat(_attributables(parts, span, sensors) for span in parts.all_spans)
    for more in (longest_object(object_runs(parts)), found):
        rows = rows.join(more, on="tracklet_id", how="left", maintain_order="left")
    linked = with_links(rows, parts)
    joined = rows["object_id"].is_null() & linked["object_id"].is_not_null()
    outcome = pl.when(joined).then(pl.lit(Outcome.LINKED.value)).otherwise("outcome")
    return from_polars(TRACKLETS, linked.with_columns(outcome=outcome))


def _attributables(parts: NightParts, span: Span, sensors: pl.DataFrame) -> pl.DataFrame:
    """Return ATTRIBUTABLES of a span, with the shared errors that `observations` have.

    `sensors` has the sensor of each tracklet.
    """
    viewed = [of.viewed for of in parts.sensors if of.viewed.holds(span)]
    rows = to_polars(concat(ATTRIBUTABLES, [each.read(span, "attributables") for each in viewed]))
    rows = rows.join(sensors, on="tracklet_id", how="left", maintain_order="left")
    errors = to_polars(parts.solved.shared_errors(span))
    return with_shared_errors(rows, errors, parts.solved.added).drop("sensor_id")


def _of_sensors(name: str, parts: NightParts) -> Iterator[pa.Table]:
    """Yield the rows of all sensors, sorted by time and then sensor, some time of a span each."""
    slices = _detections(parts) if name == "detections" else _identified(name, parts)
    for rows in slices:
        together = published_rows(name, concat(TABLES[name], rows), parts.kept)
        yield together.take(np.argsort(array(together, "time"), kind="stable"))


def published_rows(name: str, rows: pa.Table, kept: TableSettings) -> pa.Table:
    """Return the rows of a table that the settings do not leave out."""
    if name == "stars" and kept.stars_every != 1:
        number = array(rows, "frame_number")
        chosen = number % kept.stars_every == 0 if kept.stars_every else np.zeros(len(number), bool)
        return rows.filter(pa.array(chosen))
    if name == "detections" and kept.detections == "tracked":
        is_object = pc.equal(rows["kind"], "object")
        return rows.filter(pc.or_(is_object, pc.is_valid(rows["tracklet_id"])))
    return rows


def _identified(name: str, parts: NightParts) -> Iterator[list[pa.Table]]:
    """Yield the rows of each sensor, in the order of the sensors, some time of a span each."""
    column = "solutions" if name == "frames" else name
    schema = SOLUTIONS if name == "frames" else TABLES[name]
    for span in parts.spans:
        tables = [_reader(of.identified, span, schema, column) for of in parts.sensors]
        for rows in in_slices(tables, span, "time"):
            yield [conform(TABLES[name], of_sensor) for of_sensor in rows]


def _reader(parts: Parts, span: Span, schema: pa.Schema, name: str) -> Callable[[], pa.Table]:
    """Return what reads a table of one sensor with all rows of a span.

    A single part is only mapped into memory: a slice copies the few rows that it needs.
    """
    near = parts.near(span)
    if len(near) == 1:
        return partial(parts.read, near[0], name)
    return partial(parts.rows_within, span, schema, name)


def _detections(parts: NightParts) -> Iterator[list[pa.Table]]:
    """Yield the detections, in the order of the sensors, some time of a span each."""
    hot = hot_tracklets(parts)["tracklet_id"]
    for span in parts.spans:
        lone = lone_views(parts, span)
        with_rows = [of for of in parts.sensors if of.tracked.holds(span)]
        tables = [partial(of.tracked.read, span, "detections") for of in with_rows]
        for rows in in_slices(tables, span, "time"):
            named = [
                with_names(of_sensor, of.names.read(span, "names"))
                for of, of_sensor in zip(with_rows, rows, strict=True)
                if of_sensor.num_rows
            ]
            together = with_lone_objects(concat(TABLES["detections"], named), lone)
            yield [with_hot_pixels(together, hot)]


def lone_views(parts: NightParts, span: Span) -> pa.Table:
    """Return the ASSOCIATIONS of lone detections that positions of a span, or near it, used.

    An epoch of a neighbouring span may use a frame of this one.
    """
    time = span.widened(SERVED_NS)
    of_lone = pc.field("used") & pc.field("tracklet_id").is_null()
    rows = [
        rows.filter(of_lone)
        for other in spans_between(*time)
        if parts.solved.holds(other)
        for rows in parts.solved.read(other, "associations")
    ]
    return concat(ASSOCIATIONS, rows)


def _of_spans(name: str, parts: NightParts) -> Iterator[pa.Table]:
    for span in parts.spans:
        if name == "epochs":
            with_rows = [of.viewed for of in parts.sensors if of.viewed.holds(span)]
            tables = [partial(viewed.read, span, name) for viewed in with_rows]
        else:
            tables = [partial(read_part, piece, name) for piece in parts.solved.pieces(span)]
        names = parts.names.get(span.folder, {})
        for rows in in_slices(tables, span, "epoch"):
            together = concat(TABLES[name], [conform(TABLES[name], of) for of in rows])
            yield in_order(_renamed(together, names))


def _renamed(rows: pa.Table, names: Mapping[str, str]) -> pa.Table:
    """Return the rows of named objects.

    An object without a position in the span is not named: `rejects` counts its views.
    """
    if "object_id" not in rows.column_names:
        return rows
    at = rows.schema.get_field_index("object_id")
    old = pa.array(list(names), pa.string())
    rows = rows.filter(pc.is_in(rows["object_id"], old))
    new = pa.array(list(names.values()), pa.string())
    return rows.set_column(at, rows.schema.field(at), new.take(pc.index_in(rows["object_id"], old)))


def _rejects(parts: NightParts) -> Iterator[pa.Table]:
    linked = parts.linked["tracklet_id"]
    for span in parts.spans:
        for of_stage in (sensor.identified for sensor in parts.sensors):
            if of_stage.holds(span):
                yield of_stage.read(span, "rejects")
        yield from (_left_out(of, linked) for of in parts.solved.of_blocks(span, "rejects"))
        yield from parts.solved.read(span, "rejects")


def _left_out(rejects: pa.Table, linked: pa.ChunkedArray) -> pa.Table:
    """Return the rejects of a block without those of tracklets that an orbit decided later."""
    decided = pc.is_in(rejects["reason"], pa.array(DECIDED_BY_ORBITS))
    return rejects.filter(pc.invert(pc.and_(decided, pc.is_in(rejects["tracklet_id"], linked))))


def counted(rejects: Iterable[pa.Table]) -> pa.Table:
    """Return the rejects of a night; those with the trait SUMMED are summed over its spans."""
    rows = concat(REJECTS, rejects)
    summed_reasons = [reason.value for reason in Reason.having(Trait.SUMMED)]
    counted = pc.is_in(rows["reason"], pa.array(summed_reasons))
    key = ["source", "sensor_id", "reason"]
    sums = (
        rows.filter(counted)
        .group_by(key, use_threads=False)
        .aggregate(
            [
                ("time", "min"),
                ("count", "sum"),
                ("tracklet_id", "min"),
                ("tracklet_id", "count_distinct", pc.CountOptions(mode="all")),
            ]
        )
    )
    one_tracklet = pc.equal(sums["tracklet_id_count_distinct"], 1)
    summed = reject_rows(
        [Reason(name) for name in sums["reason"].to_pylist()],
        source=sums["source"],
        sensor_id=sums["sensor_id"],
        tracklet_id=pc.if_else(one_tracklet, sums["tracklet_id_min"], pa.scalar(None, pa.string())),
        time=sums["time_min"],
        count=sums["count_sum"],
    )
    return concat(REJECTS, [rows.filter(pc.invert(counted)), summed])


def source_table(sources: Sequence[LogSource], settings: Settings) -> pa.Table:
    """Return SOURCES: the logs, and the code and settings that the night was made with."""
    columns = {name: [getattr(s, name) for s in sources] for name in ("name", "size", "sha256")}
    return table(
        SOURCES,
        {
            **columns,
            "first_time": np.array([s.first_time_ns for s in sources], np.int64),
            "last_time": np.array([s.last_time_ns for s in sources], np.int64),
            "code_version": [version("epipole")] * len(sources),
            "settings_key": [settings.key()] * len(sources),
        },
    )


def into_nights(rejects: pa.Table, nights: Sequence[str], night: str) -> pa.Table:
    """Return the rejects of a night, one of `nights`.

    Those outside all nights move to the start of the nearest one. Rows without a time are about
    logs in which no time can be read: each night has them. Of a log that gave nothing this row is
    enough.
    """
    nothing = pc.equal(rejects["reason"], Reason.NOTHING_READ.value)
    of_these = pc.is_in(rejects["source"], rejects.filter(nothing)["source"].combine_chunks())
    of_these = pc.and_(of_these, pc.equal(rejects["time"].cast(pa.int64()), 0))
    rejects = rejects.filter(pc.or_(nothing, pc.invert(of_these)))
    time_ns = array(rejects, "time")
    starts = np.array([_start_ns(each) for each in nights])
    day = time_ns // DAY_NS * DAY_NS
    nearest = starts[np.argmin(np.abs(day[:, None] - starts), axis=1)]
    time_ns = np.where(np.isin(day, starts), time_ns, nearest)
    time_ns = np.where(day == 0, _start_ns(night), time_ns)
    at = rejects.column_names.index("time")
    moved = rejects.set_column(
        at, REJECTS.field("time"), pa.array(time_ns).cast(REJECTS.field("time").type)
    )
    return rows_of_night("rejects", moved, night)


def _start_ns(night: str) -> int:
    return int(np.datetime64(night, "ns").astype(np.int64))

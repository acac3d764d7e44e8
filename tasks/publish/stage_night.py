"""Stage a night: its spans' parts put together as the tables of a dataset."""

from collections.abc import Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from prefect import task
from prefect.cache_policies import NO_CACHE

from epipole.io.datasets.dataset import DAY_NS, in_order, rows_of_night
from epipole.io.datasets.night_files import write_table
from epipole.io.work.files import is_written, read_part
from epipole.schemas.bridge import array, concat, conform, table
from epipole.schemas.log_tables import LogSource
from epipole.schemas.settings import Settings
from epipole.schemas.tables import ASSOCIATIONS, REJECTS, SOURCES, TABLES, TRACKLETS
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.common.lone_detections import with_objects_found
from epipole.tasks.common.named_detections import detections_within
from epipole.tasks.common.spans import Span, rows_within
from epipole.tasks.solve.solve_span import SensorParts

# Of these a night has too many rows to be held at once; they come span by span.
BY_SENSOR = ("frames", "stars", "detections")
BY_SPAN = ("epochs", "associations", "positions", "pairs", "states")
WHOLE = ("tracklets", "calibrations", "sources", "rejects")
# What one task writes: about a third of the work each.
SHARES = (("stars",), ("detections",), ("frames", *BY_SPAN, *WHOLE))
# What these stages leave out is counted over the night: a row a span says no more.
SERVED_NS = 60_000_000_000
COUNTED = ("identify", "place_sensors", "clocks", "positions")


@task(name="stage", task_run_name="stage {tables[0]} {night}", cache_policy=NO_CACHE)
def stage_night(
    tables: Sequence[str],
    folder: Path,
    night: str,
    spans: Sequence[Span],
    sensors: Sequence[SensorParts],
    solved: Path,
    names: Mapping[str, Mapping[str, str]],
    whole: Mapping[str, pa.Table],
) -> None:
    """Write tables of a night, each sorted by time, from the parts of its spans.

    Parameters
    ----------
    tables
        Which: one of `SHARES`.
    folder
        Where the night's tables go.
    spans
        The night's own, in order.
    solved
        Parts by `solve_span`.
    names
        For each span's folder, what its objects are called in the night.
    whole
        Tables of the whole run: `calibrations`, `sources` and the `rejects` of no span.
    """
    for name in tables:
        rows: Iterator[pa.Table]
        if name in BY_SENSOR:
            rows = (_of_sensors(name, sensors, solved, span) for span in spans)
        elif name in BY_SPAN:
            rows = _of_spans(name, solved, spans, names)
        else:
            rows = iter([_of_night(name, night, sensors, solved, spans, whole)])
        write_table(folder, name, rows)


def _of_night(
    name: str,
    night: str,
    sensors: Sequence[SensorParts],
    solved: Path,
    spans: Sequence[Span],
    whole: Mapping[str, pa.Table],
) -> pa.Table:
    if name == "tracklets":
        rows = concat(TRACKLETS, [read_part(s.named / "night", "tracklets") for s in sensors])
    elif name == "rejects":
        rows = _counted([whole[name], *_rejects(sensors, solved, spans)])
    else:
        rows = whole[name]
    return in_order(rows_of_night(name, rows, night))


def _of_sensors(name: str, sensors: Sequence[SensorParts], solved: Path, span: Span) -> pa.Table:
    """Return a span's rows of all sensors by time, then sensor, then as the sensor has them."""
    schema = TABLES[name]
    if name == "detections":
        rows = [detections_within(s.tracked, s.named, span) for s in sensors]
    elif name == "frames":
        rows = [
            conform(schema, rows_within(s.identified, span, SOLUTIONS, "solutions"))
            for s in sensors
        ]
    else:
        rows = [rows_within(s.identified, span, schema, name) for s in sensors]
    together = concat(schema, rows)
    if name == "detections":  # an epoch may be served by a frame of the span beside its own
        near = rows_within(
            solved, span.widened(SERVED_NS), ASSOCIATIONS, "associations", time="epoch"
        )
        together = with_objects_found(together, near)
    return together.take(np.argsort(array(together, "time"), kind="stable"))


def _of_spans(
    name: str, solved: Path, spans: Sequence[Span], names: Mapping[str, Mapping[str, str]]
) -> Iterator[pa.Table]:
    for span in spans:
        if is_written(solved / span.folder):
            rows = read_part(solved / span.folder, name)
            yield in_order(_renamed(rows, names.get(span.folder, {})))


def _renamed(rows: pa.Table, names: Mapping[str, str]) -> pa.Table:
    if "object_id" not in rows.column_names:
        return rows
    at = rows.schema.get_field_index("object_id")
    old = pa.array(list(names), pa.string())
    new = pa.array(list(names.values()), pa.string())
    return rows.set_column(at, rows.schema.field(at), new.take(pc.index_in(rows["object_id"], old)))


def _rejects(
    sensors: Sequence[SensorParts], solved: Path, spans: Sequence[Span]
) -> Iterator[pa.Table]:
    for span in spans:
        parts = [s.identified / span.folder for s in sensors] + [solved / span.folder]
        yield from (read_part(part, "rejects") for part in parts if is_written(part))


def _counted(rejects: Sequence[pa.Table]) -> pa.Table:
    """Return the rejects of a night; those that spans counted apart, as one row each."""
    rows = concat(REJECTS, rejects)
    counted = pc.is_in(rows["stage"], pa.array(COUNTED))
    key = ["source", "sensor_id", "stage", "reason"]
    sums = (
        rows.filter(counted)
        .group_by(key, use_threads=False)
        .aggregate([("time", "min"), ("count", "sum")])
    )
    summed = {name: sums[name] for name in key}
    summed |= {"time": sums["time_min"], "count": sums["count_sum"]}
    summed["offset"] = pa.nulls(sums.num_rows, pa.int64())
    return concat(REJECTS, [rows.filter(pc.invert(counted)), table(REJECTS, summed)])


def source_table(sources: Sequence[LogSource], settings: Settings) -> pa.Table:
    """Return the rows of `sources`: the logs, and by which code and settings they were run."""
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


def into_nights(rejects: pa.Table, nights: Sequence[str]) -> pa.Table:
    """Return the rejects with those of no night at the start of the nearest, so none is lost."""
    time_ns = array(rejects, "time")
    starts = np.array([_start_ns(night) for night in nights])
    day = time_ns // DAY_NS * DAY_NS
    nearest = starts[np.argmin(np.abs(day[:, None] - starts), axis=1)]
    time_ns = np.where(np.isin(day, starts), time_ns, nearest)
    at = rejects.column_names.index("time")
    return rejects.set_column(
        at, REJECTS.field("time"), pa.array(time_ns).cast(REJECTS.field("time").type)
    )


def _start_ns(night: str) -> int:
    return int(np.datetime64(night, "ns").astype(np.int64))

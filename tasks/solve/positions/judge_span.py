"""Judge a span: the sensors whose shared errors are larger than stated, part to part."""

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.work.part_tables import JUDGED
from epipole.io.work.parts import write_part
from epipole.io.work.places import SolvedParts, ViewedParts
from epipole.schemas.bridge import to_polars
from epipole.schemas.settings import Settings
from epipole.schemas.spans import Span
from epipole.schemas.stages import Stage
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.solve.positions.fit_states import judge_errors
from epipole.tasks.solve.positions.gather_views import gather_views
from epipole.tasks.solve.positions.solve_positions import solve_positions

ENOUGH = 8  # objects that show the errors of a sensor


@stage_task(Stage.SOLVE, "errors {span}")
def judge_span(
    viewed: ViewedParts,
    span: Span,
    margin_ns: int,
    every_ns: int,
    most_views: int,
    settings: Settings,
    solved: SolvedParts,
) -> None:
    """Write SHARED_ERRORS of a span, `JUDGED`, unless the part exists.

    Parameters
    ----------
    viewed
        The parts of the views of the sensors.
    every_ns, most_views
        Only epochs that are multiples of this time since midnight are solved, and objects with so
        many views at most, all epochs counted.
    solved
        `objects` is read, `errors` gets the part.
    """
    if solved.errors.holds(span):
        return
    members = telling_objects(solved.objects.read(span, "members"), most_views)
    views, number = gather_views(viewed, members, span.widened(margin_ns), every_ns)
    found = solve_positions(views, number, settings, span)
    errors = judge_errors(views, found.associations, found.positions, settings)
    write_part(solved.errors.of(span), JUDGED, {"errors": errors})


def telling_objects(members: pa.Table, most_views: int) -> pa.Table:
    """Return the OBJECT_MEMBERS of objects with so many views together, at most.

    Where these are not all, each sensor gets some: those with few objects first, each its longest.
    """
    rows = to_polars(members)
    if rows["n_views"].sum() <= most_views:
        return members
    size = dict(rows.group_by("object").agg(pl.col("n_views").sum()).iter_rows())
    seen = (
        rows.group_by("sensor", "object")
        .agg(pl.col("n_views").sum())
        .with_columns(objects=pl.len().over("sensor"))
        .sort("objects", "sensor", "n_views", "object", descending=[False, False, True, False])
    )
    of_sensor: dict[int, list[int]] = {}
    for sensor, object_ in seen.select("sensor", "object").iter_rows():
        of_sensor.setdefault(sensor, []).append(object_)
    sees = {o: set(s) for o, s in seen.group_by("object").agg(pl.col("sensor")).iter_rows()}
    chosen: set[int] = set()
    held = 0
    for sensor, objects in of_sensor.items():
        for object_ in objects:
            enough = sum(sensor in sees[one] for one in chosen) >= ENOUGH
            if enough or (chosen and held + size[object_] > most_views):
                break
            if object_ not in chosen:
                chosen.add(object_)
                held += size[object_]
    return members.filter(pa.array(np.isin(rows["object"].to_numpy(), sorted(chosen))))

"""OBJECT_MEMBERS and views of sensors for tests: a few rows, times in seconds."""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa

from epipole.io.work.parts import Parts
from epipole.schemas.spans import SPAN_NS, Span
from epipole.schemas.work_tables import OBJECT_MEMBERS, SENSOR_EPOCHS, TRACKLET_RUNS, VIEWS
from epipole.tasks.solve.association_input import SensorViews
from epipole.tasks.solve.views import viewed_tracklets
from scenes.associations import START_NS, filled, write_views

SECOND_NS = 1_000_000_000
SPANS = [Span(START_NS + k * SPAN_NS, START_NS + (k + 1) * SPAN_NS) for k in range(3)]


def ns(seconds: float) -> int:
    """Return a time since the first span's start."""
    return START_NS + round(seconds * SECOND_NS)


def members(*rows: Sequence) -> pa.Table:
    """Return members: object, sensor, tracklet, track, first and last epoch [s], views."""
    number, sensor, tracklet, track, first, last, n_views = zip(*rows, strict=True)
    return filled(OBJECT_MEMBERS, len(rows), {
        "object": number, "sensor": sensor, "tracklet_id": tracklet, "track_id": track,
        "first_epoch": [ns(t) for t in first], "last_epoch": [ns(t) for t in last],
        "n_views": n_views,
    })  # fmt: skip


def views_of(sensor: int, tracklets: Mapping[str, Sequence[float]], missed=()) -> SensorViews:
    """Return the views of tracklets at some times [s]; those in `missed` have no centroid."""
    rows = [(name, t) for name, times in sorted(tracklets.items()) for t in sorted(times)]
    n = len(rows)
    views = filled(VIEWS, n, {
        "epoch": [ns(t) for _, t in rows], "sensor_id": [f"s{sensor}"] * n,
        "tracklet_id": [name for name, _ in rows],
        "centroid": [None if row in missed else 7 for row in rows],
    })  # fmt: skip
    names = sorted(tracklets)
    runs = filled(TRACKLET_RUNS, len(names), {"tracklet_id": names, "track_id": names})
    epochs = filled(SENSOR_EPOCHS, 0, {})
    return SensorViews(sensor, f"s{sensor}", lambda: views, epochs, viewed_tracklets(runs, views))


def write_spans(folder: Path, sensors: Sequence[SensorViews]) -> Mapping[int, Parts]:
    """Write the views of sensors, each part with those of its span; spans without have none."""
    viewed: dict[int, Parts] = {of.number: Parts(folder / str(of.number)) for of in sensors}
    for span in SPANS:
        for of in sensors:
            views = span.of(of.read_views(), "epoch")
            if views.num_rows:
                tracklets = viewed_tracklets(of.tracklets, views)
                write_views(
                    folder,
                    [of._replace(read_views=partial(pa.Table.slice, views), tracklets=tracklets)],
                    span,
                )
    return viewed


def seconds(views: pa.Table) -> list[float]:
    """Return the epochs of views since the first span's start [s]."""
    return ((np.array(views["epoch"].cast(pa.int64())) - START_NS) / SECOND_NS).tolist()

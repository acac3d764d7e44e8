"""Measure tracks: whether each is of one object, and whether each object has one."""

import numpy as np
import polars as pl

from epipole.tasks.algorithms.evaluation import majority
from epipole.tasks.evaluate.match_points import OBJECT, Measures, integers, share, true_objects

TRACK = ["sensor_id", "track_id"]


def measure_tracks(detections: pl.DataFrame, points: pl.DataFrame) -> Measures:
    """Return purity and completeness of the tracks; nothing where no detection has a track.

    The object of a track is the one that most of its detections show. `detections` are those of
    `detected_objects`.
    """
    tracked = detections.drop_nulls("track_id")
    if not tracked.height:
        return {}
    tracks = tracked.select(TRACK).unique(maintain_order=True).with_row_index("number")
    tracked = tracked.join(tracks, on=TRACK, how="left", maintain_order="left")
    most = majority(integers(tracked, "number"), true_objects(tracked), tracks.height)
    n_right = int(most.votes.sum())
    of_track = tracks.select("sensor_id", true_object=pl.Series(most.value))
    of_track = of_track.filter(pl.col("true_object") >= 0)
    n_tracks = of_track.group_by("sensor_id", "true_object").len()["len"]
    return {
        "tracks": tracks.height,
        "track_purity": share(n_right, tracked.height),
        "track_completeness": share(n_right, points.filter(pl.col("kind") == OBJECT).height),
        "tracks_per_target": float(np.mean(n_tracks.to_numpy())) if len(n_tracks) else None,
    }

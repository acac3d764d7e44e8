"""The report of an evaluation: a dataset compared with the truth of a simulated log."""

import math
from dataclasses import dataclass, field, fields
from typing import Any


def _measure(group: str, label: str, style: str = "count", *, definition: str) -> Any:
    metadata = {"group": group, "label": label, "style": style, "definition": definition}
    return field(default=None, metadata=metadata)


@dataclass(frozen=True)
class Report:
    """The measures of an evaluation, each with its definition in the metadata of its field.

    A measure is missing (None) if there was nothing to measure, or if it is infinite because a
    covariance is invalid. Shares are 0 to 1. Attitude errors are in arcseconds about the sensor
    axes. Position errors are in kilometres, GCRF, against the true position at the time of the
    estimate.

    An estimate is an object that the dataset reports at an epoch, and a view is one sensor's part
    in it. The true object of an estimate is the one that most of its views show, at least two. An
    estimate without a true object is a ghost. A possible estimate is a true object at an epoch in
    which at least two frames of sensors without a fault show it. A passage is an object in one
    sensor, in at least five frames, without a gap of more than two seconds. NEES is the squared
    error, normalised by the covariance.
    """

    frames: int | None = _measure(
        "frames", "in the dataset", definition="Rows of the table frames."
    )
    frames_duplicated: int | None = _measure(
        "frames", "more than once", definition="Rows of frames that repeat an earlier row's frame."
    )
    frames_solved: float | None = _measure(
        "frames",
        "attitude from stars",
        "share",
        definition="Frames with an attitude from stars, as a share of the true frames.",
    )

    stars_claimed: int | None = _measure(
        "stars", "identified", definition="Rows of the table stars."
    )
    star_precision: float | None = _measure(
        "stars", "precision", "share", definition="Identified stars whose number is the true one."
    )
    star_recall: float | None = _measure(
        "stars",
        "recall",
        "share",
        definition="Rightly identified stars, as a share of the centroids that are stars.",
    )

    att_cross_arcsec_median: float | None = _measure(
        "attitude",
        "boresight, median",
        "arcsec",
        definition="Median error of the boresight of attitudes from stars.",
    )
    att_cross_arcsec_p99: float | None = _measure(
        "attitude",
        "boresight, 99 %",
        "arcsec",
        definition="99 % of the attitudes from stars have a smaller error of the boresight.",
    )
    att_roll_arcsec_median: float | None = _measure(
        "attitude",
        "roll, median",
        "arcsec",
        definition="Median size of the error about the boresight of attitudes from stars.",
    )
    att_wrong: int | None = _measure(
        "attitude",
        "wrong (error above 6', roll 30')",
        definition="Attitudes from stars with an error above 6' (boresight) or 30' (roll).",
    )

    epochs: int | None = _measure(
        "associations", "epochs", definition="Different epochs of the table epochs."
    )
    groups: int | None = _measure(
        "associations", "objects reported at epochs", definition="Estimates."
    )
    pair_precision: float | None = _measure(
        "associations",
        "pair precision",
        "share",
        definition="Pairs of views in one estimate that show one true object; views without a "
        "centroid are skipped.",
    )
    pair_recall: float | None = _measure(
        "associations",
        "pair recall",
        "share",
        definition="Right pairs, as a share of all pairs of centroids of one object at an epoch.",
    )
    object_recall: float | None = _measure(
        "associations",
        "object recall",
        "share",
        definition="Possible estimates that the dataset has, as a share of all possible ones.",
    )
    ghosts: int | None = _measure(
        "associations", "ghosts", definition="Estimates without a true object."
    )

    positions: int | None = _measure(
        "positions",
        "of true objects",
        definition="Positions of estimates that have a true object, which is never blended with "
        "another one.",
    )
    positions_blended: int | None = _measure(
        "positions",
        "of blended objects",
        definition="Positions of true objects that share a centroid with another object in some "
        "frame: their errors are not measured.",
    )
    positions_of_ghosts: int | None = _measure(
        "positions", "of ghosts", definition="Positions of estimates without a true object."
    )
    positions_per_truth: float | None = _measure(
        "positions",
        "per interval with two sensors",
        "number",
        definition="Positions of true objects, per object and frame interval of the slowest "
        "sensor in which at least two sensors see the object. 1: one in each; a little more where "
        "both ends of a sequence have an epoch.",
    )
    pos_err_km_median: float | None = _measure(
        "positions",
        "error, median",
        "km",
        definition="Median distance of the positions to the true ones.",
    )
    pos_err_km_p95: float | None = _measure(
        "positions",
        "error, 95 %",
        "km",
        definition="95 % of the positions are nearer to the true ones.",
    )
    pos_err_km_max: float | None = _measure(
        "positions",
        "error, largest",
        "km",
        definition="Largest distance of a position to the true one.",
    )
    axis_rms_km: tuple[float, float, float] | None = _measure(
        "positions", "rms x, y, z", "km", definition="Root mean square error along each axis."
    )
    nees_median: float | None = _measure(
        "positions",
        "NEES, median (expected: 2.37)",
        "number",
        definition="Median NEES of the positions; 2.37 where the covariances are right.",
    )
    nees_in_99: float | None = _measure(
        "positions",
        "in the 99 % ellipsoid",
        "share",
        definition="Positions with a NEES below 11.345; 99 % where the covariances are right.",
    )
    nees_mean: float | None = _measure(
        "positions",
        "NEES / 3, mean (expected: 1)",
        "number",
        definition="Mean over the true objects of the mean NEES / 3 of their positions; 1 where "
        "the covariances are right.",
    )
    nees_mean_sigma: float | None = _measure(
        "positions",
        "its standard error",
        "number",
        definition="Standard error of nees_mean: standard deviation over the objects, divided by "
        "the root of their number.",
    )

    objects_seen_by_two: int | None = _measure(
        "objects",
        "possible at ten epochs or more",
        definition="True objects with at least ten possible estimates.",
    )
    objects_lost: int | None = _measure(
        "objects",
        "of these lost",
        definition="Those of which the dataset has less than half of the possible estimates.",
    )
    ids_per_target: float | None = _measure(
        "objects", "ids per object", "number", definition="Mean number of ids of a true object."
    )
    longest_id_share: float | None = _measure(
        "objects",
        "share of the main id",
        "share",
        definition="Share of a true object's positions that have its most frequent id; mean over "
        "the true objects.",
    )
    id_swaps: int | None = _measure(
        "objects",
        "ids that pass to another object",
        definition="How often two successive positions of one id are of different true objects; "
        "ghosts are skipped.",
    )

    observations: int | None = _measure(
        "observations",
        "of objects",
        definition="Rows of the table observations that have an object.",
    )
    observations_of_others: int | None = _measure(
        "observations",
        "of something else",
        definition="Those that do not show the true object of their id: the one that most of its "
        "observations show.",
    )
    observation_recall: float | None = _measure(
        "observations",
        "recall",
        "share",
        definition="The others of true objects that have a position, as a share of all centroids "
        "of these objects.",
    )
    observation_nees_mean: float | None = _measure(
        "observations",
        "NEES / 2, mean (expected: 1)",
        "number",
        definition="Mean over the true objects of the mean NEES / 2 of their observations, by all "
        "errors that a row states; 1 where these are right.",
    )
    observation_nees_mean_sigma: float | None = _measure(
        "observations",
        "its standard error",
        "number",
        definition="Standard error of observation_nees_mean. Errors that all frames of a sensor "
        "share are not in it.",
    )
    magnitudes: int | None = _measure(
        "observations",
        "magnitudes",
        definition="Observations of true objects with a magnitude, where the truth tells it.",
    )
    magnitude_error_median: float | None = _measure(
        "observations",
        "magnitude error, median",
        "mag",
        definition="Median size of the error of these magnitudes.",
    )
    magnitude_nees_mean: float | None = _measure(
        "observations",
        "magnitude error over sigma, squared, mean (expected: 1)",
        "number",
        definition="Mean over the true objects of the mean squared error over variance of their "
        "magnitudes.",
    )

    states: int | None = _measure(
        "states",
        "of true objects",
        definition="States of ids with a position of a true object; the state is compared with "
        "the true object that most of these positions are of.",
    )
    states_of_nothing: int | None = _measure(
        "states", "of ghosts", definition="States of ids without a position of a true object."
    )
    states_err_km_median: float | None = _measure(
        "states",
        "error, median",
        "km",
        definition="Median distance of the states to the true positions.",
    )
    states_nees_mean: float | None = _measure(
        "states",
        "NEES / 6, mean (expected: 1)",
        "number",
        definition="Mean NEES / 6 of the states (position and velocity); 1 where the covariances "
        "are right.",
    )
    states_nees_median: float | None = _measure(
        "states",
        "NEES, median (expected: 5.35)",
        "number",
        definition="Median NEES of the states; 5.35 where the covariances are right.",
    )
    states_nees_max: float | None = _measure(
        "states", "NEES, largest", "number", definition="Largest NEES of a state."
    )
    states_in_99: float | None = _measure(
        "states",
        "in the 99 % ellipsoid",
        "share",
        definition="States with a NEES below 16.81; 99 % where the covariances are right.",
    )

    orbits: int | None = _measure(
        "orbits",
        "of true objects",
        definition="Orbits of ids whose observations show a true object; the orbit is compared "
        "with the true object that most of these show.",
    )
    orbits_of_nothing: int | None = _measure(
        "orbits", "of ghosts", definition="Orbits of ids whose observations show no true object."
    )
    orbits_err_km_median: float | None = _measure(
        "orbits",
        "error, median",
        "km",
        definition="Median distance of the orbits, at their epochs, to the true positions.",
    )
    orbits_nees_mean: float | None = _measure(
        "orbits",
        "NEES / 6, mean (expected: 1)",
        "number",
        definition="Mean NEES / 6 of the orbits' states; 1 where the covariances are right.",
    )
    orbits_nees_median: float | None = _measure(
        "orbits",
        "NEES, median (expected: 5.35)",
        "number",
        definition="Median NEES of the orbits' states; 5.35 where the covariances are right.",
    )
    orbits_nees_max: float | None = _measure(
        "orbits", "NEES, largest", "number", definition="Largest NEES of an orbit's state."
    )
    orbits_in_99: float | None = _measure(
        "orbits",
        "in the 99 % ellipsoid",
        "share",
        definition="Orbits with a NEES below 16.81; 99 % where the covariances are right.",
    )

    tracks: int | None = _measure(
        "tracks", "tracks", definition="Different tracks of detections that are called objects."
    )
    track_purity: float | None = _measure(
        "tracks",
        "purity",
        "share",
        definition="Detections with a track that show the object most of their track shows.",
    )
    track_completeness: float | None = _measure(
        "tracks",
        "completeness",
        "share",
        definition="The same detections, as a share of all centroids that are objects.",
    )
    tracks_per_target: float | None = _measure(
        "tracks",
        "tracks per object and sensor",
        "number",
        definition="Mean number of tracks of an object in a sensor.",
    )

    passages: int | None = _measure(
        "passages",
        "passages",
        definition="Objects in one sensor in at least five frames, without a gap above 2 s.",
    )
    passages_tracked: float | None = _measure(
        "passages",
        "with a tracklet",
        "share",
        definition="Passages of which one tracklet has at least half of the detections.",
    )
    passages_fast: int | None = _measure(
        "passages",
        "above 2 deg/s",
        definition="Passages whose direction changes by more than 2 degrees per second.",
    )
    passages_fast_tracked: float | None = _measure(
        "passages",
        "of these with a tracklet",
        "share",
        definition="Fast passages of which one tracklet has at least half of the detections.",
    )
    passages_observed: float | None = _measure(
        "passages",
        "with observations",
        "share",
        definition="Passages of which at least half of the detections are observations.",
    )
    detections_observed: float | None = _measure(
        "passages",
        "detections that are observations",
        "share",
        definition="Rows of observations in passages, as a share of the passages' detections.",
    )
    passage_pairs: int | None = _measure(
        "passages",
        "pairs of satellites",
        definition="Pairs of passages of one object through sensors of different satellites, both "
        "with a tracklet.",
    )
    passages_joined: float | None = _measure(
        "passages",
        "of these joined",
        "share",
        definition="Pairs whose tracklets have the same object_id.",
    )

    tracklets: int | None = _measure(
        "tracklets", "tracklets", definition="Different tracklets of the table detections."
    )
    tracklets_false: int | None = _measure(
        "tracklets",
        "that are no object",
        definition="Tracklets of which no object has at least half of the detections.",
    )
    joined_wrong: int | None = _measure(
        "tracklets",
        "of another object than their id",
        definition="Tracklets whose object is not the one that most tracklets of their object_id "
        "show.",
    )
    named_right: float | None = _measure(
        "tracklets",
        "named rightly",
        "share",
        definition="Tracklets whose identification is the true catalogue number, as a share of "
        "those that show an object.",
    )
    named_wrong: int | None = _measure(
        "tracklets",
        "named wrongly",
        definition="Tracklets whose identification is another catalogue number.",
    )

    def as_dict(self) -> dict[str, Any]:
        """Return the measures by name, ready for JSON."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {k: list(v) if isinstance(v, tuple) else v for k, v in values.items()}

    def rows(self) -> list[tuple[str, str, str]]:
        """Return group, label and formatted value of each measure that is not None."""
        return [
            (f.metadata["group"], f.metadata["label"], _text(value, f.metadata["style"]))
            for f in fields(self)
            if (value := getattr(self, f.name)) is not None
        ]


def _text(value: Any, style: str) -> str:
    if isinstance(value, tuple):
        return ", ".join(_text(v, "bare") for v in value) + " km"
    if style == "share":  # rounded down: 100.00% means all
        value = math.floor(value * 1e4 + 1e-9) / 1e4
    form = {
        "count": "{:,}",
        "share": "{:.2%}",
        "arcsec": "{:.2f} arcsec",
        "km": "{:.4f} km",
        "bare": "{:.4f}",
        "mag": "{:.3f} mag",
        "number": "{:.2f}",
    }[style]
    return form.format(value)

"""The measures of `epipole evaluate`, in the order of its report.

Each function returns some measures by name; `schemas/evaluation.py` defines the names. Where a
dataset states sigmas, squared errors are divided by the variances (NEES): per axis their mean is 1
if the sigmas are right.
"""

from collections.abc import Sequence

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.simulation.truth import Truth
from epipole.schemas.bridge import array, stack, stack_covariance, to_polars
from epipole.schemas.columns import STATE_AXES
from epipole.tasks.algorithms.constants import ARCSEC, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.evaluation import (
    attitude_errors,
    count_changes,
    majority,
    mean_of_group_means,
    pairs_within,
    squared_normalised_errors,
)
from epipole.tasks.algorithms.geometry.directions import east_north, unit_from_radec
from epipole.tasks.evaluate.matching import (
    FRAME,
    OBJECT,
    POINT,
    STAR,
    Array,
    Indices,
    Measures,
    faulty_sensors,
    integers,
    locate_objects,
    share,
    true_objects,
    with_truth,
)

TRACK = ["sensor_id", "track_id"]

# Larger errors of an attitude are those of a wrong identification.
WRONG_CROSS_ARCSEC, WRONG_ROLL_ARCSEC = 360.0, 1800.0
MIN_POSSIBLE_EPOCHS = 10  # an object possible at fewer epochs is not counted as lost
LOST_SHARE = 0.5  # found at a smaller share of its possible epochs: lost
POSITION_AXES, DIRECTION_AXES, STATE_COMPONENTS = 3, 2, 6
# 99 % of the chi-square of 3 and of 6 degrees of freedom.
POSITION_CHI2_99, STATE_CHI2_99 = 11.345, 16.81
LIGHT_ITERATIONS = 3  # an object moves 1e-4 of the path of its light: each iteration gains 4 digits


def measure_stars(stars: pl.DataFrame, points: pl.DataFrame) -> Measures:
    """Return how many identified stars are right, and how many of the true stars they are."""
    identified = with_truth(stars.select(*POINT, "star_id"), points)
    is_right = (pl.col("kind") == STAR) & (pl.col("source") == pl.col("star_id"))
    n_right = identified.filter(is_right).height
    n_true = points.filter(pl.col("kind") == STAR).height
    return {
        "stars_claimed": stars.height,
        "star_precision": share(n_right, stars.height),
        "star_recall": share(n_right, n_true),
    }


def measure_attitudes(frames: pl.DataFrame, true_frames: pl.DataFrame) -> Measures:
    """Return how many true frames have an attitude from stars, and the errors of these attitudes.

    A frame that the dataset has more than once is measured by its first row.
    """
    once = frames.unique(FRAME, keep="first", maintain_order=True)
    solved = once.filter(pl.col("attitude_source") == "stars").join(
        true_frames, on=FRAME, how="inner", suffix="_true"
    )
    counts = {
        "frames": frames.height,
        "frames_duplicated": frames.height - once.height,
        "frames_solved": share(solved.height, true_frames.height),
    }
    return counts | (_attitude_errors(solved) if solved.height else {})


def _attitude_errors(solved: pl.DataFrame) -> Measures:
    names = ["qx", "qy", "qz", "qw"]
    q_found = solved.select(names).to_numpy()
    q_true = solved.select([f"{name}_true" for name in names]).to_numpy()
    cross, roll = (np.abs(angle) / ARCSEC for angle in attitude_errors(q_found, q_true))
    wrong = (cross > WRONG_CROSS_ARCSEC) | (roll > WRONG_ROLL_ARCSEC)
    return {
        "att_cross_arcsec_median": float(np.median(cross)),
        "att_cross_arcsec_p99": float(np.quantile(cross, 0.99)),
        "att_roll_arcsec_median": float(np.median(roll)),
        "att_wrong": int(np.sum(wrong)),
    }


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


def measure_associations(
    views: pl.DataFrame, estimates: pl.DataFrame, possible: pl.DataFrame, epochs: pl.DataFrame
) -> Measures:
    """Return how many pairs of views and how many estimates are right.

    A pair is two views of one estimate that have centroids. The possible pairs are all pairs of
    centroids of one object in the frames of one epoch.
    """
    with_centroid = views.filter("has_centroid")
    n_pairs, n_right = pairs_within(
        integers(with_centroid, "estimate"),
        integers(with_centroid, "true_object"),
        estimates.height,
    )
    n_views = integers(possible, "n_views")
    n_possible = int(np.sum(n_views * (n_views - 1) // 2))
    return {
        "epochs": epochs["epoch"].n_unique(),
        "groups": estimates.height,
        "pair_precision": share(n_right, n_pairs),
        "pair_recall": share(n_right, n_possible),
        "object_recall": share(_found(possible, estimates).height, possible.height),
        "ghosts": estimates.filter(pl.col("true_object") < 0).height,
    }


def measure_lost_objects(possible: pl.DataFrame, estimates: pl.DataFrame) -> Measures:
    """Return how many objects two frames show at ten epochs or more, and how many were lost.

    An object is lost where the dataset has it at less than half of these epochs.
    """
    n_found = _found(possible, estimates).group_by("true_object").agg(n_found=pl.len())
    objects = possible.group_by("true_object").agg(n_possible=pl.len())
    objects = objects.filter(pl.col("n_possible") >= MIN_POSSIBLE_EPOCHS)
    objects = objects.join(n_found, on="true_object", how="left")
    is_lost = pl.col("n_found").fill_null(0) < LOST_SHARE * pl.col("n_possible")
    return {
        "objects_seen_by_two": objects.height,
        "objects_lost": objects.filter(is_lost).height,
    }


def _found(possible: pl.DataFrame, estimates: pl.DataFrame) -> pl.DataFrame:
    """Return the possible estimates that the dataset has."""
    return possible.join(estimates, on=["epoch", "true_object"], how="semi")


def measure_positions(
    positions: pa.Table, matched: pl.DataFrame, truth: Truth, blended: Sequence[int] = ()
) -> Measures:
    """Return the number and the errors of positions of true objects.

    Parameters
    ----------
    positions
        POSITIONS.
    matched
        The rows of `match_positions`, in the same order.
    blended
        Objects whose errors are not measured: `blended_objects`.
    """
    of_object = integers(matched, "true_object")
    is_blended = np.isin(of_object, blended)
    real = (of_object >= 0) & ~is_blended
    counts = {
        "positions": int(real.sum()),
        "positions_blended": int(is_blended.sum()),
        "positions_of_ghosts": int((of_object < 0).sum()),
    }
    if not real.any():
        return counts | {"nees_in_99": 0.0}
    positions, of_object = positions.filter(pa.array(real)), of_object[real]
    r_true_km, _ = locate_objects(truth, of_object, array(positions, "time"))
    error_km = stack(positions, "{}_km") - r_true_km
    distance_km = np.linalg.norm(error_km, axis=1)
    nees = squared_normalised_errors(error_km, stack_covariance(positions, "cov_{}"))
    mean, sigma = mean_of_group_means(of_object, nees / POSITION_AXES)
    return counts | {
        "pos_err_km_median": float(np.median(distance_km)),
        "pos_err_km_p95": float(np.quantile(distance_km, 0.95)),
        "pos_err_km_max": float(distance_km.max()),
        "axis_rms_km": tuple(np.sqrt(np.mean(error_km**2, axis=0)).tolist()),
        "nees_median": float(np.median(nees)),
        "nees_in_99": float(np.mean(nees < POSITION_CHI2_99)),
        "nees_mean": mean,
        "nees_mean_sigma": sigma,
    }


def measure_ids(matched: pl.DataFrame) -> Measures:
    """Return how many ids true objects have, and how often an id passes to another object.

    `matched` are the rows of `match_positions`.
    """
    real = matched.filter(pl.col("true_object") >= 0).sort("object_id", "epoch", "true_object")
    ids = real["object_id"].rank("dense").to_numpy().astype(np.int64)
    swaps = {"id_swaps": count_changes(ids, integers(real, "true_object"))}
    if not real.height:
        return swaps
    per_id = real.group_by("true_object", "object_id").agg(n=pl.len())
    of_object = per_id.group_by("true_object").agg(
        ids=pl.len(), main=pl.col("n").max() / pl.col("n").sum().cast(pl.Float64)
    )
    return swaps | {
        "ids_per_target": float(np.mean(of_object["ids"].to_numpy())),
        "longest_id_share": float(np.mean(of_object["main"].to_numpy())),
    }


def measure_coverage(n: int, truth: Truth, frames: pl.DataFrame, points: pl.DataFrame) -> Measures:
    """Return the number `n` of positions as a share of the possible ones.

    A position is possible per object and frame interval of the slowest sensor, if two sensors
    without a fault see the object in it.
    """
    rate_hz = min(sensor["rate_hz"] for sensor in truth.scenario["sensors"])
    since_ns = pl.col("t_ns") - int(truth.scenario["t0_ns"])
    is_sound = ~pl.col("sensor_id").is_in(faulty_sensors(truth))
    shown = points.filter((pl.col("kind") == OBJECT) & is_sound)
    shown = shown.join(frames.select(*FRAME, "t_ns"), on=FRAME)
    shown = shown.with_columns(interval=(since_ns * (rate_hz / 1e9)).floor())
    n_sensors = shown.group_by("interval", "source").agg(n=pl.col("sensor_id").n_unique())
    return {"positions_per_truth": share(n, n_sensors.filter(pl.col("n") >= 2).height)}


def measure_observations(
    observations: pa.Table,
    points: pl.DataFrame,
    matched: pl.DataFrame,
    truth: Truth,
    blended: Sequence[int] = (),
) -> Measures:
    """Return the number and the errors of the observations of true objects.

    The true object of an id is the one that most of its observations show.

    Parameters
    ----------
    observations
        OBSERVATIONS.
    points
        The centroids of the truth.
    matched
        The rows of `match_positions`: observations are expected of objects with a position.
    blended
        Objects whose errors are not measured: `blended_objects`.
    """
    observations = observations.filter(pc.is_valid(observations["object_id"]))
    rows = to_polars(observations.select(["object_id", *POINT]))
    shown = true_objects(with_truth(rows, points))
    number = rows["object_id"].rank("dense").to_numpy().astype(np.int64) - 1
    of_id = majority(number, shown, int(number.max(initial=-1)) + 1).value[number]
    right = (shown >= 0) & (shown == of_id)
    found = matched.filter(pl.col("true_object") >= 0)["true_object"].unique()
    expected = points.filter((pl.col("kind") == OBJECT) & pl.col("source").is_in(found.implode()))
    as_expected = right & np.isin(shown, found.to_numpy())
    measures = {
        "observations": len(rows),
        "observations_of_others": int(np.sum(~right)),
        "observation_recall": share(float(np.sum(as_expected)), expected.height),
    }
    right &= ~np.isin(shown, blended)
    if not right.any():
        return measures
    seen, of_object = observations.filter(pa.array(right)), shown[right]
    nees = _squared_errors(seen, of_object, truth)
    mean, sigma = mean_of_group_means(of_object, nees / DIRECTION_AXES)
    measures |= {"observation_nees_mean": mean, "observation_nees_mean_sigma": sigma}
    return measures | _magnitudes(seen, of_object, points)


def _magnitudes(seen: pa.Table, of_object: Indices, points: pl.DataFrame) -> Measures:
    """Return the errors of magnitudes, where the truth has them."""
    rows = to_polars(seen.select([*POINT, "magnitude", "magnitude_sigma"]))
    true = points.select(*POINT, true="magnitude")
    rows = rows.join(true, on=POINT, how="left", maintain_order="left")
    error = (rows["magnitude"] - rows["true"]).cast(pl.Float64).to_numpy()
    sigma = rows["magnitude_sigma"].cast(pl.Float64).to_numpy()
    known = np.isfinite(error / sigma)
    if not known.any():
        return {}
    nees, _ = mean_of_group_means(of_object[known], (error[known] / sigma[known]) ** 2)
    return {
        "magnitudes": int(known.sum()),
        "magnitude_error_median": float(np.median(np.abs(error[known]))),
        "magnitude_nees_mean": nees,
    }


def _squared_errors(seen: pa.Table, of_object: Indices, truth: Truth) -> Array:
    """Return the squared errors of directions, normalised by all that the rows state."""
    u = unit_from_radec(np.radians(array(seen, "ra_deg")), np.radians(array(seen, "dec_deg")))
    line_km = _lines(seen, of_object, truth)
    distance_km = np.linalg.norm(line_km, axis=1)
    off = np.einsum("nij,nj->ni", east_north(u), u - line_km / distance_km[:, None])
    sigma = np.stack([array(seen, f"sigma_{a}_arcsec") for a in ("ra", "dec")], axis=1) * ARCSEC
    shared = np.hypot(
        array(seen, "bias_sigma_arcsec") * ARCSEC, array(seen, "position_sigma_km") / distance_km
    )
    cov = np.eye(2) * (sigma**2 + shared[:, None] ** 2)[:, None, :]
    cov[:, 0, 1] = cov[:, 1, 0] = array(seen, "correlation") * sigma[:, 0] * sigma[:, 1]
    return squared_normalised_errors(off, cov)


def _lines(seen: pa.Table, of_object: Indices, truth: Truth) -> Array:
    """Return from each observation's sensor to where its object was when the light left [km]."""
    time_ns, from_km = array(seen, "time"), stack(seen, "{}_km")
    light_ns = np.zeros(len(time_ns))
    for _ in range(LIGHT_ITERATIONS):
        r_km, _v = locate_objects(truth, of_object, time_ns - light_ns.astype(np.int64))
        light_ns = np.linalg.norm(r_km - from_km, axis=1) / SPEED_OF_LIGHT_KM_S * 1e9
    return np.asarray(r_km - from_km)


def measure_states(
    states: pa.Table, matched: pl.DataFrame, truth: Truth, blended: Sequence[int] = ()
) -> Measures:
    """Return the number and the errors of states of true objects.

    The true object of a state is the one that most positions of its id are of. A state whose id
    has no position of a true object is a state of nothing.

    Parameters
    ----------
    states
        STATES.
    matched
        The rows of `match_positions`.
    blended
        Objects whose errors are not measured: `blended_objects`.
    """
    of_state = _objects_of_ids(to_polars(states.select(["object_id"])), matched)
    return _measure_motions("states", states, of_state, truth, blended)


def measure_orbits(
    orbits: pa.Table,
    observations: pa.Table,
    points: pl.DataFrame,
    truth: Truth,
    blended: Sequence[int] = (),
) -> Measures:
    """Return the number and the errors of orbits of true objects.

    The true object of an orbit is the one that most observations of its id show.

    Parameters
    ----------
    orbits, observations
        ORBITS and OBSERVATIONS.
    points
        The centroids of the truth.
    blended
        Objects whose errors are not measured: `blended_objects`.
    """
    seen = to_polars(observations.select(["object_id", *POINT])).drop_nulls("object_id")
    shown = with_truth(seen, points)
    shown = shown.with_columns(true_object=pl.Series(true_objects(shown), dtype=pl.Int64))
    of_orbit = _objects_of_ids(to_polars(orbits.select(["object_id"])), shown)
    return _measure_motions("orbits", orbits, of_orbit, truth, blended)


def _measure_motions(
    name: str, states: pa.Table, of_state: Indices, truth: Truth, blended: Sequence[int]
) -> Measures:
    """Return the measures of STATES or ORBITS, each with its true object or -1."""
    n_of_nothing = int((of_state < 0).sum())
    real = (of_state >= 0) & ~np.isin(of_state, blended)
    if not real.any():
        return {name: 0} | ({f"{name}_of_nothing": n_of_nothing} if n_of_nothing else {})
    states, of_state = states.filter(pa.array(real)), of_state[real]
    error = _state_errors(states, of_state, truth)
    nees = squared_normalised_errors(error, stack_covariance(states, "cov_{}", STATE_AXES))
    return {
        name: len(nees),
        f"{name}_of_nothing": n_of_nothing,
        f"{name}_nees_mean": float(np.mean(nees)) / STATE_COMPONENTS,
        f"{name}_nees_median": float(np.median(nees)),
        f"{name}_nees_max": float(nees.max()),
        f"{name}_in_99": float(np.mean(nees < STATE_CHI2_99)),
        f"{name}_err_km_median": float(np.median(np.linalg.norm(error[:, :3], axis=1))),
    }


def _objects_of_ids(states: pl.DataFrame, matched: pl.DataFrame) -> Indices:
    """Return the true object of each state's `object_id`, -1 if unknown."""
    real = matched.filter(pl.col("true_object") >= 0)
    ids = real.select("object_id").unique(maintain_order=True).with_row_index("number")
    number = real.join(ids, on="object_id", how="left", maintain_order="left")
    most = majority(integers(number, "number"), integers(number, "true_object"), ids.height)
    ids = ids.select("object_id", true_object=pl.Series(most.value))
    found = states.join(ids, on="object_id", how="left", maintain_order="left")
    return integers(found.with_columns(pl.col("true_object").fill_null(-1)), "true_object")


def _state_errors(states: pa.Table, of_state: Indices, truth: Truth) -> Array:
    """Return position and velocity minus the truth, (n, 6) [km and km/s]."""
    r_km, v_km_s = locate_objects(truth, of_state, array(states, "epoch"))
    return np.hstack([stack(states, "{}_km") - r_km, stack(states, "v{}_km_s") - v_km_s])

"""Measure observations: whose they are, and whether their errors agree with their sigmas."""

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.simulation.truth import Truth
from epipole.schemas.bridge import array, stack, to_polars
from epipole.tasks.algorithms.constants import ARCSEC, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.evaluation import (
    majority,
    mean_of_group_means,
    squared_normalised_errors,
)
from epipole.tasks.algorithms.geometry.sky import east_north, unit_from_radec
from epipole.tasks.evaluate.locate_objects import locate_objects
from epipole.tasks.evaluate.match_points import (
    OBJECT,
    POINT,
    Array,
    Indices,
    Measures,
    share,
    true_objects,
    with_truth,
)

AXES = 2
LIGHT_ITERATIONS = 3  # the object moves by a ten-thousandth of the way of its light


def measure_observations(
    observations: pa.Table, points: pl.DataFrame, matched: pl.DataFrame, truth: Truth
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
    """
    rows = to_polars(observations.select(["object_id", *POINT]))
    shown = true_objects(with_truth(rows, points))
    number = rows["object_id"].rank("dense").to_numpy().astype(np.int64) - 1
    of_id = majority(number, shown, int(number.max(initial=-1)) + 1).value[number]
    right = (shown >= 0) & (shown == of_id)
    found = matched.filter(pl.col("true_object") >= 0)["true_object"].unique()
    expected = points.filter((pl.col("kind") == OBJECT) & pl.col("source").is_in(found.implode()))
    measures = {
        "observations": len(rows),
        "observations_of_others": int(np.sum(~right)),
        "observation_recall": share(float(np.sum(right)), expected.height),
    }
    if not right.any():
        return measures
    seen, of_object = observations.filter(pa.array(right)), shown[right]
    nees = _squared_errors(seen, of_object, truth)
    mean, sigma = mean_of_group_means(of_object, nees / AXES)
    measures |= {"observation_nees_mean": mean, "observation_nees_mean_sigma": sigma}
    return measures | _magnitudes(seen, of_object, points)


def _magnitudes(seen: pa.Table, of_object: Indices, points: pl.DataFrame) -> Measures:
    """Return the errors of magnitudes, where the truth tells them."""
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

"""Measure states: errors, and whether their covariances agree with them."""

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.simulation.truth import Truth
from epipole.schemas.bridge import array, stack, stack_covariance, to_polars
from epipole.schemas.columns import STATE_AXES
from epipole.tasks.algorithms.evaluation import majority, squared_normalised_errors
from epipole.tasks.evaluate.locate_objects import locate_objects
from epipole.tasks.evaluate.match_points import Array, Indices, Measures, integers

INSIDE_99 = 16.81  # 99 % of the chi-square of 6 degrees of freedom
AXES = 6


def measure_states(states: pa.Table, matched: pl.DataFrame, truth: Truth) -> Measures:
    """Return the number and the errors of states of true objects.

    The true object of a state is the one that most positions of its id are of. A state whose id
    has no position of a true object is a state of nothing.

    Parameters
    ----------
    states
        STATES.
    matched
        The rows of `match_positions`.
    """
    of_state = _objects_of_ids(to_polars(states.select(["object_id"])), matched)
    real = of_state >= 0
    if not real.any():
        return {"states": 0}
    states, of_state = states.filter(pa.array(real)), of_state[real]
    error = _state_errors(states, of_state, truth)
    nees = squared_normalised_errors(error, stack_covariance(states, "cov_{}", STATE_AXES))
    return {
        "states": len(nees),
        "states_of_nothing": int((~real).sum()),
        "states_nees_mean": float(np.mean(nees)) / AXES,
        "states_nees_median": float(np.median(nees)),
        "states_nees_max": float(nees.max()),
        "states_in_99": float(np.mean(nees < INSIDE_99)),
        "states_err_km_median": float(np.median(np.linalg.norm(error[:, :3], axis=1))),
    }


def _objects_of_ids(states: pl.DataFrame, matched: pl.DataFrame) -> Indices:
    """Return the true object of each state's `object_id`, -1 where the id has none."""
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

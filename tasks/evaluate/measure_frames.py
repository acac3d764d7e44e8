"""Measure stars and attitudes against the truth."""

import numpy as np
import polars as pl

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.evaluation import attitude_errors
from epipole.tasks.evaluate.match_points import FRAME, POINT, STAR, Measures, share, with_truth

WRONG_CROSS_ARCSEC, WRONG_ROLL_ARCSEC = 360.0, 1800.0


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

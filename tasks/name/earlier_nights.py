"""Earlier nights: an unknown object is recognised by its motion as one of an earlier night."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.datasets.night_files import read_columns
from epipole.schemas.bridge import stack_covariance
from epipole.schemas.columns import PLACE, STATE_AXES, VELOCITY
from epipole.schemas.settings import Settings
from epipole.schemas.tables import STATES
from epipole.tasks.algorithms.orbits.object_linking import ObservedMotions, link_by_motion

HOUR_S = 3600.0


def recognise_objects(
    folder: Path, objects: Sequence[str], earlier: pa.Table, settings: Settings
) -> dict[str, str]:
    """Return the ids that objects of a night had in an earlier one, where their motion decides.

    Parameters
    ----------
    folder
        The night's folder; its `states` are written.
    objects
        Ids of the objects to recognise. Ids that an earlier night knows already are skipped.
    earlier
        STATES of earlier nights.

    Notes
    -----
    The last state of the earlier object is propagated to the first one of the night; see
    `link_by_motion` for forces, process noise and when a link is refused.
    """
    gap_s = settings.known_objects.earlier_h * HOUR_S
    if not (len(objects) and earlier.num_rows and gap_s > 0.0):
        return {}
    before = pl.DataFrame(earlier)
    new = pl.DataFrame(read_columns(folder, "states", STATES.names))
    new = new.filter(
        pl.col("object_id").is_in(list(objects))
        & ~pl.col("object_id").is_in(before["object_id"].unique().to_list())
    )
    old = before.sort("epoch").unique("object_id", keep="last").sort("object_id")
    new = new.sort("epoch").unique("object_id", keep="first").sort("object_id")
    if not (len(old) and len(new)):
        return {}
    both = pl.concat([old, new])
    is_old = np.arange(len(both)) < len(old)
    links, _ = link_by_motion(
        _motions(both),
        gap_s=gap_s,
        log_odds=settings.states.link_log_odds,
        allowed=is_old[:, None] & ~is_old,
    )
    names = both["object_id"].to_list()
    return {names[k]: names[i] for k, i in enumerate(links.tolist()) if i >= 0}


def _motions(states: pl.DataFrame) -> ObservedMotions:
    """Return motions that are known at one instant each."""
    time_ns = states["epoch"].cast(pl.Int64).to_numpy()
    at_s = (time_ns - time_ns.min()) / 1e9
    motion = states.select([*PLACE, *VELOCITY]).to_numpy()
    cov = stack_covariance(states, "cov_{}", STATE_AXES)
    return ObservedMotions(at_s, at_s, at_s, at_s, motion, motion, cov, cov)

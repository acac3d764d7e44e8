"""Judge the stated errors of centroids by the scatter of the stars about their positions."""

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.arrays import Array
from epipole.schemas.bridge import array, flatten, to_polars
from epipole.schemas.stages import Stage
from epipole.tasks.algorithms.log_checks.findings import Finding
from epipole.tasks.algorithms.log_checks.frames import check_star_scatter
from epipole.tasks.calibrate.calibrate_sensors import SensorStars
from epipole.tasks.common.batches import Batch
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.identify.frame_inputs import optional_values
from epipole.tasks.read.judge_sensor import checks_table
from epipole.tasks.read.order_frames import frames_between

MAX_FRAMES = 200  # with stars, of the span that is looked at


@stage_task(Stage.CALIBRATE, "errors of {sensors}")
def judge_star_scatter(frames: ReadFolder, sensors: Batch[SensorStars]) -> pa.Table:
    """Return CHECKS of the sensors that state errors of centroids and have enough stars.

    Parameters
    ----------
    frames
        Where `order_sensors` put the frames.
    """
    found = {each.sensor.sensor_id: _judge(frames, each) for each in sensors}
    return checks_table({name: [one] for name, one in found.items() if one is not None})


def _judge(frames: ReadFolder, each: SensorStars) -> Finding | None:
    counts = [each.identified.read(span, "stars").num_rows for span in each.spans]
    if not any(counts):
        return None
    span = each.spans[int(np.argmax(counts))]
    exposures = frames_between(frames, each.sensor.number, *span)
    stars = to_polars(each.identified.read(span, "stars"))
    numbers = np.unique(stars["frame_number"].to_numpy())
    sampled = numbers[:: -(-len(numbers) // MAX_FRAMES)]
    stars = stars.filter(pl.col("frame_number").is_in(sampled.tolist()))
    sigma_px = stated_sigmas(exposures, stars)
    # A frame some of whose stars have no stated error would have too few residuals for its fit.
    whole = stars.with_columns(sigma=sigma_px).filter(
        pl.col("sigma").is_finite().all().over("frame_number")
    )
    dx, dy, sigma = (whole[name].to_numpy() for name in ("dx_px", "dy_px", "sigma"))
    return check_star_scatter(dx, dy, sigma, whole["frame_number"].n_unique())


def stated_sigmas(exposures: pa.Table, stars: pl.DataFrame) -> Array:
    """Return the stated errors (n,) of stars [px], NaN where unknown.

    `stars` have `frame_number` and `centroid`, the index in the lists of EXPOSURES.
    """
    _, first = flatten(exposures, "x_px")
    logged, number = array(exposures, "frame_number"), stars["frame_number"].to_numpy()
    out = np.full(len(number), np.nan)
    if not len(logged):
        return out
    order = np.argsort(logged, kind="stable")
    frame = order[np.maximum(np.searchsorted(logged[order], number, side="right") - 1, 0)]
    has = logged[frame] == number
    centroid = first[frame[has]] + stars["centroid"].to_numpy()[has]
    out[has] = optional_values(exposures, "sigma_px")[centroid]
    return out

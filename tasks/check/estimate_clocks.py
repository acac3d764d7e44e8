"""Estimate clocks: each sensor's clock offset over the night."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import polars as pl

from epipole.io.work.parts import Parts
from epipole.schemas.bridge import stack, stack_covariance, to_polars
from epipole.schemas.columns import TANGENT_AXES
from epipole.schemas.spans import Span
from epipole.schemas.stages import Stage
from epipole.tasks.algorithms.sensor_faults.clock_offset import Lines, clock_offsets
from epipole.tasks.algorithms.sensor_faults.clock_search import Meetings, search_offset
from epipole.tasks.common.stage_tasks import stage_task

Array = npt.NDArray[np.float64]

MOST_EPOCHS = 300  # more do not help: the offset is one constant
KNOWN_S = 1.0  # with a larger sigma a clock counts as unknown


class Clock(NamedTuple):
    """A sensor's clock: reported minus true time of its frames, and the 1-sigma error of that.

    `is_off` says whether the clock is certainly wrong.
    """

    sensor_id: str
    offset_s: float
    sigma_s: float
    is_off: bool

    def __str__(self) -> str:
        """Return the offset as a sentence."""
        side = "late" if self.offset_s > 0 else "early"
        return (
            f"the clock of {self.sensor_id} is {abs(self.offset_s):.3f} s {side} "
            f"(sigma {self.sigma_s:.3f} s)"
        )


@stage_task(Stage.CHECK, "clocks")
def estimate_clocks(solved: Parts, spans: Sequence[Span]) -> list[Clock]:
    """Return the clocks that the lines of sight of the night determine, by sensor.

    Parameters
    ----------
    solved
        The parts of `solve_span` of these spans.
    """
    parts = []
    for span in spans:
        rows = to_polars(solved.read(span, "clock_views"))
        # The ids of objects are those of the span.
        object_id = pl.format("{}/{}", pl.lit(span.folder), "object_id")
        parts.append(rows.with_columns(object_id=object_id))
    if not parts:
        return []
    rows = pl.concat(parts)
    epochs = rows["epoch"].unique().sort()
    kept = epochs[:: max(-(-len(epochs) // MOST_EPOCHS), 1)]
    return clocks_of(rows.filter(pl.col("epoch").is_in(kept.implode())))


def clocks_of(rows: pl.DataFrame) -> list[Clock]:
    """Return the clocks that CLOCK_VIEWS determine, by sensor."""
    claimed = rows.filter(pl.col("claimed"))
    first_guess, of_objects = {}, [claimed]
    for (sensor_id,), of_sensor in rows.group_by("sensor_id", maintain_order=True):
        match = _search(of_sensor.filter(~pl.col("claimed")))
        if match is not None:
            first_guess[str(sensor_id)], matched = match
            key = ["epoch", "object_id", "sensor_id"]
            of_objects.append(matched.join(claimed, on=key, how="anti"))
    rows = pl.concat(of_objects).sort("epoch", "object_id", "sensor_id")
    if not len(rows):
        return []
    spread = (pl.col("cov_bias_11_rad2") + pl.col("cov_bias_22_rad2")) / 2
    bias = rows.group_by("sensor_id").agg(
        pl.col("position_sigma_km").max(), attitude_sigma_rad=spread.max().sqrt()
    ).sort("sensor_id")  # fmt: skip
    offsets = clock_offsets(
        _lines(rows, bias["sensor_id"]),
        bias["position_sigma_km"].to_numpy(),
        bias["attitude_sigma_rad"].to_numpy(),
        np.array([first_guess.get(name, 0.0) for name in bias["sensor_id"]]),
    )
    return [
        Clock(name, float(offset), float(sigma), bool(off))
        for name, offset, sigma, off in zip(bias["sensor_id"], *offsets, strict=True)
        if sigma < KNOWN_S
    ]


def _search(free: pl.DataFrame) -> tuple[float, pl.DataFrame] | None:
    """Return the offset at which a sensor's views fit objects, and these views."""
    if not len(free):
        return None
    match = search_offset(
        Meetings(
            tracklet=free["tracklet_id"].rank("dense").to_numpy().astype(np.int64),
            item=free["object_id"].rank("dense").to_numpy().astype(np.int64),
            u=stack(free, "u{}"),
            cov=_direction_cov(free, "noise") + _direction_cov(free, "bias"),
            r_km=stack(free, "sensor_{}_km"),
            v_sensor_km_s=stack(free, "sensor_v{}_km_s"),
            sigma_km=free["position_sigma_km"].to_numpy(),
            x_km=stack(free, "{}_km"),
            v_km_s=stack(free, "v{}_km_s"),
            cov_km2=stack_covariance(free, "cov_{}"),
        )
    )
    return None if match is None else (match.offset_s, free[match.row])


def _lines(rows: pl.DataFrame, sensors: pl.Series) -> Lines:
    """Return views of objects as lines of sight; sensors are numbered in the given order."""
    return Lines(
        group=rows.select(pl.struct("epoch", "object_id").rle_id()).to_series().to_numpy(),
        sensor=np.asarray(sensors.search_sorted(rows["sensor_id"]), np.int64),
        u=stack(rows, "u{}"),
        cov=_direction_cov(rows, "noise"),
        x_km=stack(rows, "{}_km"),
        v_km_s=stack(rows, "v{}_km_s"),
        r_km=stack(rows, "sensor_{}_km"),
        v_sensor_km_s=stack(rows, "sensor_v{}_km_s"),
    )


def _direction_cov(rows: pl.DataFrame, which: str) -> Array:
    return stack_covariance(rows, f"cov_{which}_{{}}_rad2", TANGENT_AXES)


def total_offsets(before: Sequence[Clock], now: Sequence[Clock]) -> list[Clock]:
    """Return the clocks with their offsets in the logs: corrections so far, and what remains."""
    corrected = {clock.sensor_id: clock for clock in before if clock.is_off}
    total = [
        clock._replace(
            offset_s=clock.offset_s + corrected[clock.sensor_id].offset_s, is_off=True
        ) if clock.sensor_id in corrected else clock
        for clock in now
    ]  # fmt: skip
    remaining = {clock.sensor_id for clock in now}
    total += [clock for name, clock in corrected.items() if name not in remaining]
    return sorted(total)

"""The last nights of a dataset: a few numbers of each."""

import logging
from collections.abc import Iterable
from typing import NamedTuple

import polars as pl

from epipole.io.datasets.night_reader import NightReader
from epipole.schemas.errors import DatasetError

LOGGER = logging.getLogger(__name__)

MOST_NIGHTS = 30


class NightNumbers(NamedTuple):
    """What is compared between nights; `focal_px` is the focal length of each sensor."""

    night: str
    frames: int
    identified: int
    objects: int
    positions: int
    rejects: int
    focal_px: dict[str, float]

    @property
    def identified_share(self) -> float:
        """The share of frames that are identified."""
        return self.identified / self.frames if self.frames else 0.0


def read_trend(nights: Iterable[NightReader]) -> list[NightNumbers]:
    """Return the numbers of nights, in their order. A night that cannot be read has a line."""
    numbers = []
    for night in nights:
        try:
            numbers.append(_numbers(night))
        except DatasetError as error:
            LOGGER.warning("left out of the trend: %s", error)
    return numbers


def _numbers(night: NightReader) -> NightNumbers:
    frames = identified = positions = 0
    for rows in night.pieces("frames", ["attitude_source"]):
        frames += len(rows)
        identified += int((rows["attitude_source"] == "stars").sum())
    objects: set[str] = set()
    for rows in night.pieces("positions", ["object_id"]):
        positions += len(rows)
        objects.update(rows["object_id"].unique())
    rejects = sum(int(rows["count"].sum()) for rows in night.pieces("rejects", ["count"]))
    optics = night.read("calibrations", ["sensor_id", "fx_px", "fy_px"])
    mean = (pl.col("fx_px") * pl.col("fy_px")).abs().sqrt()
    focal_px = dict(optics.select("sensor_id", mean).iter_rows())
    return NightNumbers(night.night, frames, identified, len(objects), positions, rejects, focal_px)

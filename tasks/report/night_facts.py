"""All that the report says of a night, computed from its tables."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import polars as pl

from epipole.io.datasets.night_reader import NightReader
from epipole.tasks.report.epipolar_views import OPTICS, EpipolarViews, read_epipolar_views
from epipole.tasks.report.frame_series import FrameSeries, read_frame_series
from epipole.tasks.report.left_out import LeftOut, read_left_out
from epipole.tasks.report.night_objects import NightObject, read_objects
from epipole.tasks.report.sky_tracks import SkyTracks, read_sky_tracks
from epipole.tasks.report.solved_chi2 import SolvedChi2, read_solved_chi2
from epipole.tasks.report.star_map import StarMap, read_star_map
from epipole.tasks.report.star_residuals import StarResiduals, read_star_residuals
from epipole.tasks.report.trend import NightNumbers, read_trend

_CALIBRATIONS = ["sensor_id", *OPTICS, "sigma_fx_px", "sigma_fy_px", "n_stars", "residual_px"]


class NightFacts(NamedTuple):
    """What the report says. None, or empty: the night has no such rows.

    `trend` ends with the night itself; `counts` are rows by table.
    """

    night: str
    dataset: str
    sources: pl.DataFrame
    counts: dict[str, int]
    series: FrameSeries | None
    left_out: list[LeftOut]
    calibrations: pl.DataFrame
    residuals: StarResiduals | None
    chi2: SolvedChi2
    star_catalogue: str
    star_map: StarMap | None
    tracks: SkyTracks | None
    epipolar: EpipolarViews | None
    objects: list[NightObject]
    trend: list[NightNumbers]

    def size_px(self, sensor_id: str) -> np.ndarray:
        """Return about the size of a sensor's image."""
        if self.residuals is None:
            return np.array([1.0, 1.0])
        size: np.ndarray = self.residuals.size_px[self.residuals.sensors.index(sensor_id)]
        return size


COUNTED = ("frames", "stars", "detections", "tracklets", "associations", "positions", "states",
           "observations")  # fmt: skip


def read_night_facts(
    night: NightReader, dataset: str, earlier: Sequence[NightReader] = ()
) -> NightFacts:
    """Return what the report says of a night.

    Parameters
    ----------
    dataset
        Its name for people.
    earlier
        Nights before it, in order, for the trend.
    """
    series = read_frame_series(night)
    calibrations = night.read("calibrations", _CALIBRATIONS)
    residuals = views = None
    if series is not None:
        residuals = read_star_residuals(night, series.sensors, calibrations)
    if residuals is not None:
        sizes = dict(zip(residuals.sensors, residuals.size_px, strict=True))
        views = read_epipolar_views(night, calibrations, sizes)
    return NightFacts(
        night=night.night,
        dataset=dataset,
        sources=night.read("sources", ["name", "size", "code_version", "settings_key"]),
        counts={name: night.count(name) for name in COUNTED},
        series=series,
        left_out=read_left_out(night),
        calibrations=calibrations.sort("sensor_id"),
        residuals=residuals,
        chi2=read_solved_chi2(night),
        star_catalogue=night.metadata("stars", "catalogue"),
        star_map=None if series is None else read_star_map(night, series),
        tracks=read_sky_tracks(night),
        epipolar=views,
        objects=read_objects(night),
        trend=read_trend([*earlier, night]),
    )

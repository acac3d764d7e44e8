"""Some frames of one sensor, what is known of it, and their identification with that."""

from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from epipole.tasks.algorithms.star_identification.frames.centroids import (
    RawCentroids,
    SensorCentroids,
    Solutions,
    unsolved,
)
from epipole.tasks.algorithms.star_identification.frames.frame import FieldOfView, Search, Solution
from epipole.tasks.algorithms.star_identification.reidentify_poor_frames import SensorSky
from epipole.tasks.algorithms.star_identification.sequence import Priors, identify_sequence
from epipole.tasks.algorithms.star_identification.sky.camera_sky import Sky
from epipole.tasks.algorithms.star_identification.sky.pair_table import PairTable
from epipole.tasks.algorithms.star_identification.sky.sky_grid import SkyGrid

Array = npt.NDArray[np.float64]


class Skies(Protocol):
    """The source of skies; it may cache them, as sensors share them."""

    def limit_for(self, stars_per_sr: float) -> float:
        """Return the magnitude limit with this mean density."""

    def sky(self, limit: float) -> Sky:
        """Return the sky to a magnitude."""

    def grid(self, limit: float, radius_rad: float) -> SkyGrid:
        """Return its grid."""

    def pairs(self, limit: float, optics: FieldOfView) -> PairTable:
        """Return its pattern pairs for a camera."""


class Known(NamedTuple):
    """What has been learned of a sensor."""

    scale: float  # on the errors as stated, or on 1 px
    limit: float  # faintest star searched for
    limit_is_open: bool  # the settings do not state it
    how: Search
    use_flux: bool  # brightness is compared
    adjusted: bool  # errors are not as stated, or not stated


class Sample(NamedTuple):
    """Frames, with their priors; `anchors` are frames whose prior is an earlier solution."""

    t_s: Array
    spots: RawCentroids
    priors: Priors
    anchors: bool = False

    def take(self, rows: npt.NDArray[np.int64]) -> "Sample":
        priors = Priors(self.priors.R_sensor_from_icrs[rows], self.priors.sigma_rad[rows])
        return Sample(self.t_s[rows], self.spots.take(rows), priors, self.anchors)

    def anchored(self, rows: npt.NDArray[np.int64], solutions: list[Solution | None]) -> "Sample":
        """Return the frames with these solutions as priors, where they have none of their own."""
        R, sigma = self.priors.R_sensor_from_icrs.copy(), self.priors.sigma_rad.copy()
        for row, solution in zip(rows, solutions, strict=True):
            if solution is not None and np.isnan(self.priors.sigma_rad[row]):
                R[row] = solution.R_sensor_from_icrs
                # Errors and sky were other ones: it may be off by more than it says.
                sigma[row] = 3.0 * np.sqrt(np.trace(solution.cov_rad2) / 3.0)
        return self._replace(priors=Priors(R, sigma), anchors=True)

    def of_quality(self, quality: Array) -> "Sample":
        """Return the frames with these factors on their errors."""
        spots = self.spots
        stated = np.where(np.isnan(spots.sigma_px), 1.0, spots.sigma_px)
        scaled = spots._replace(sigma_px=stated * np.repeat(quality, spots.counts))
        return self._replace(spots=scaled)


def identify_sample(
    sample: Sample, skies: Skies, known: Known, hopeless: bool = False
) -> tuple[Solutions, list[str | None]]:
    """Return the frames' solutions and status; `hopeless` ones have failed so far."""
    if not len(sample.t_s):
        return unsolved(sample.spots.first), []
    frames = sample.spots.frames(known.scale, known.use_flux)
    return identify_sequence(
        sample.t_s, frames, sample.priors, *sky_of(sample.spots, skies, known), known.how,
        sample.anchors, hopeless,
    )  # fmt: skip


def sky_of(spots: RawCentroids, skies: Skies, known: Known) -> SensorSky:
    """Return what the frames are searched in."""
    radius = _grid_radius(spots.frames(known.scale), known.how)
    pairs = partial(skies.pairs, known.limit, spots.optics[0])
    return SensorSky(skies.sky(known.limit), skies.grid(known.limit, radius), pairs)


def _grid_radius(frames: SensorCentroids, how: Search) -> float:
    """Return the widest look-up [rad], rounded up so that similar sensors share a grid."""
    sigma = frames.sigma_rad
    widest = 2.5 * how.gate_sigma * float(np.median(sigma)) if len(sigma) else 1e-3
    return float(min(2.0 ** (np.ceil(2 * np.log2(widest)) / 2), 0.1))

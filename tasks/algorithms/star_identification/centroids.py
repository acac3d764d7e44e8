"""All frames of one sensor in flat arrays, and centroids that stay at one pixel.

Frame k has the centroids first[k]:first[k + 1]. `RawCentroids` have errors in pixels as stated,
`SensorCentroids` in radians as assumed; `Solutions` say which star each centroid is.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices, Integers
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.star_identification.frame import FieldOfView, FrameCentroids, Solution


class SensorCentroids(NamedTuple):
    """Frames in order of time, centroids brightest first.

    first : (F + 1,) int64
    u, sigma_rad, instrumental_mag : (N, 3), (N,), (N,) float, as in `frame.FrameCentroids`
    beta : (F, 3) float
    optics, optics_of : the cameras, and (F,) int64, which camera took each frame
    """

    first: Indices
    u: Array
    sigma_rad: Array
    instrumental_mag: Array
    beta: Array
    optics: Sequence[FieldOfView]
    optics_of: Indices

    def frame(self, k: int) -> FrameCentroids:
        """Return one frame."""
        at = slice(self.first[k], self.first[k + 1])
        return FrameCentroids(
            self.u[at], self.sigma_rad[at], self.instrumental_mag[at], self.beta[k],
            self.optics[self.optics_of[k]],
        )  # fmt: skip

    def each(self) -> list[FrameCentroids]:
        """Return all frames, one by one."""
        return [self.frame(k) for k in range(len(self.beta))]


class RawCentroids(NamedTuple):
    """Centroids of frames, brightest first in each, with their errors as stated.

    first : (F + 1,) int64
    u, pixel_rad : (N, 3), (N,) float, directions, and the angle that a pixel spans there
    sigma_px : (N,) float, NaN where unknown
    instrumental_mag : (N,) float, NaN where unknown
    beta, optics, optics_of : as in `SensorCentroids`
    """

    first: Indices
    u: Array
    pixel_rad: Array
    sigma_px: Array
    instrumental_mag: Array
    beta: Array
    optics: Sequence[FieldOfView]
    optics_of: Indices

    @property
    def counts(self) -> Indices:
        """(F,) centroids of each frame."""
        return np.diff(self.first)

    def take(self, frames: Indices) -> "RawCentroids":
        """Return the centroids of these frames."""
        n = self.counts[frames]
        first = np.concatenate([[0], np.cumsum(n)])
        at = np.arange(first[-1]) + np.repeat(self.first[frames] - first[:-1], n)
        return self._rows(first, at, frames)

    def parts(self, parts: Sequence[Indices], frames: Indices) -> "RawCentroids":
        """Return parts of frames (rows of centroids) as frames."""
        first = np.concatenate([[0], np.cumsum([len(part) for part in parts])]).astype(np.int64)
        return self._rows(first, np.concatenate([np.zeros(0, np.int64), *parts]), frames)

    def _rows(self, first: Indices, at: Indices, frames: Indices) -> "RawCentroids":
        return RawCentroids(
            first, self.u[at], self.pixel_rad[at], self.sigma_px[at], self.instrumental_mag[at],
            self.beta[frames], self.optics, self.optics_of[frames],
        )  # fmt: skip

    def with_floor(self, floor_px: float) -> "RawCentroids":
        """Return the centroids with an error added in quadrature to the stated ones."""
        return self._replace(sigma_px=np.hypot(self.sigma_px, floor_px))

    def frames(self, scale: float, use_flux: bool = True) -> SensorCentroids:
        """Return the frames with their errors scaled; errors that are not stated count as 1 px."""
        sigma_px = np.where(np.isnan(self.sigma_px), 1.0, self.sigma_px) * scale
        mag = self.instrumental_mag if use_flux else np.full(len(sigma_px), np.nan)
        return SensorCentroids(
            self.first, self.u, sigma_px * self.pixel_rad, mag, self.beta, self.optics,
            self.optics_of,
        )  # fmt: skip


class Solutions(NamedTuple):
    """Solutions of all frames.

    solved : (F,) bool
    R_sensor_from_icrs, cov_rad2 : (F, 3, 3) float, as in `frame.Solution`; NaN where not solved
    star, chi2 : (N,) int64 and float; -1 and 0 where there is no star
    evidence : (F,) float, NaN where not solved
    first : (F + 1,) int64
    """

    solved: Flags
    R_sensor_from_icrs: Array
    cov_rad2: Array
    star: Indices
    chi2: Array
    evidence: Array
    first: Indices

    def frame(self, k: int) -> Solution | None:
        """Return a frame's solution, None where it is not solved."""
        if not self.solved[k]:
            return None
        at = slice(self.first[k], self.first[k + 1])
        return Solution(
            self.R_sensor_from_icrs[k], self.cov_rad2[k], self.star[at], self.chi2[at],
            float(self.evidence[k]),
        )  # fmt: skip

    def each(self) -> list[Solution | None]:
        """Return all solutions, one by one."""
        return [self.frame(k) for k in range(len(self.solved))]

    def enter(self, k: int, solution: Solution) -> None:
        """Write a frame's solution."""
        at = slice(self.first[k], self.first[k + 1])
        self.solved[k] = True
        self.R_sensor_from_icrs[k] = solution.R_sensor_from_icrs
        self.cov_rad2[k] = solution.cov_rad2
        self.star[at], self.chi2[at] = solution.star, solution.chi2
        self.evidence[k] = solution.evidence

    def enter_all(self, rows: Indices, other: "Solutions", of: Indices) -> None:
        """Write the frames `of` of other solutions, all of them solved, to the frames `rows`."""
        for row, k in zip(rows.tolist(), of.tolist(), strict=True):
            solution = other.frame(k)
            if solution is not None:
                self.enter(row, solution)

    def rescaled(self, scale: float) -> "Solutions":
        """Return the solutions for errors this many times as large."""
        return self._replace(cov_rad2=self.cov_rad2 * scale**2, chi2=self.chi2 / scale**2)


def unsolved(first: Indices) -> Solutions:
    """Return the solutions of frames before any is solved."""
    n = len(first) - 1
    return Solutions(
        np.zeros(n, np.bool_), np.full((n, 3, 3), np.nan), np.full((n, 3, 3), np.nan),
        np.full(first[-1], -1, np.int64), np.zeros(first[-1]), np.full(n, np.nan), first,
    )  # fmt: skip


@kernel
def brightest_first(first, flux):
    """Return the rows of each frame's centroids, brightest first, NaN last; equal ones keep their
    order (compiled).

    Frame k of F has the centroids first[k]:first[k + 1] of `flux` (N,), in any unit; `first` is
    (F + 1,) int. The rows are (N,) int64.
    """
    row = np.arange(len(flux))
    for k in range(len(first) - 1):
        if first[k + 1] - first[k] > 200:  # insertion is quadratic
            brightness = flux[first[k] : first[k + 1]].copy()
            for m in range(len(brightness)):
                if np.isnan(brightness[m]):
                    brightness[m] = -np.inf
            row[first[k] : first[k + 1]] = first[k] + np.argsort(-brightness, kind="mergesort")
            continue
        for m in range(first[k] + 1, first[k + 1]):
            at = m
            while at > first[k] and (
                flux[m] > flux[row[at - 1]] or (np.isnan(flux[row[at - 1]]) and flux[m] == flux[m])
            ):
                row[at] = row[at - 1]
                at -= 1
            row[at] = m
    return row


# Centroids that stay at one pixel: hot pixels, where the sky moves over the image.


def filled_sigmas(sigma_px: Array) -> Array:
    """Return stated errors (n,), the median of them where one is missing (NaN); NaN without any."""
    if not np.isfinite(sigma_px).any():
        return sigma_px
    return np.where(np.isnan(sigma_px), np.nanmedian(sigma_px), sigma_px)


# Least number of frames, and least share of all frames, with a centroid at a pixel that is static.
MIN_STATIC_FRAMES, MIN_STATIC_SHARE = 4, 0.3


def static_centroids(first: Integers, x_px: Array, y_px: Array) -> Flags:
    """Return which centroids of a sensor's frames are at a pixel where many frames have one.

    So are stars if the sensor keeps its direction: the caller decides.

    Parameters
    ----------
    first : (F + 1,) int64
        Frame k has the centroids first[k]:first[k + 1].
    x_px, y_px : (N,) float
        Pixel positions; one that is not finite is not static.
    """
    n_frames = len(first) - 1
    least = max(MIN_STATIC_FRAMES, int(np.ceil(MIN_STATIC_SHARE * n_frames)))
    frame = np.repeat(np.arange(n_frames), np.diff(first))
    stays = np.zeros(len(x_px), np.bool_)
    at = np.flatnonzero(np.isfinite(x_px) & np.isfinite(y_px))
    # A position at the corner of four pixels is in the middle of a shifted one; at a side it has
    # half of its frames in each of two, which is enough.
    for shift in (0.0, 0.5):
        cell = _cells(x_px[at] + shift, y_px[at] + shift)
        once = _without_repeats(np.sort(cell * n_frames + frame[at])) // n_frames
        last = once[least - 1 :]  # of `least` frames in a row: at one pixel, or at several
        full = _without_repeats(last[last == once[: len(last)]])
        stays[at] |= np.isin(cell, full)
    return stays


def _without_repeats(ordered: Integers) -> Integers:
    """Return each of some sorted values once; `numpy.unique` takes thirty times as long."""
    return ordered[np.append(True, ordered[1:] != ordered[:-1])[: len(ordered)]]


def _cells(x_px: Array, y_px: Array) -> Integers:
    """Return a number for each pixel."""
    column, row = (np.clip(np.floor(v), -1e6, 1e6).astype(np.int64) for v in (x_px, y_px))
    return (column + 1_000_000) * 4_000_000 + row + 1_000_000

"""Cameras whose told focal length or handedness is wrong: how often one frame shows the true one.

    python tests/benchmarks/bench_unknown_cameras.py [--frames 100] [--reach 1.11]

Frames of Hipparcos' stars in random directions, half of them mirrored: 0.3 px of error, 3 false
points, 10 % of the stars missing, no sigma in the log. Right: the focal length is within 0.5 % of
the true one, and the handedness is right.
"""

import argparse
import time
from typing import NamedTuple

import numpy as np
from star_frames import Kind, expose, hipparcos_at_epoch, seen_stars

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.arrays import Array
from epipole.tasks.algorithms.geometry.camera import Camera, mirrored
from epipole.tasks.algorithms.geometry.directions import canonical, matrix_from_quaternion
from epipole.tasks.algorithms.star_identification.camera_search import ImageFrame, find_cameras
from epipole.tasks.algorithms.star_identification.frame import MatchSettings
from epipole.tasks.algorithms.star_identification.sensor_model import Skies
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue

KINDS = (
    Kind("4", 4.0, 1024, 8.5),
    Kind("6", 6.0, 1024, 7.3),
    Kind("8", 8.0, 1024, 7.0),
    Kind("12", 12.0, 512, 6.0),
    Kind("20", 20.3, 1024, 5.5),
    Kind("40", 40.0, 2048, 5.0),
)
DAY = int(np.datetime64("2024-01-01").astype(int))
HOW = MatchSettings(3.7, -np.log(1e-5), 0.5, np.nan)  # the defaults of a run
CATALOGUE = Catalogue(read_hipparcos())


class Tally(NamedTuple):
    """Counts of frames, median CPU time of a frame [s], rms of focal length [1]."""

    right: int
    wrong: int
    cpu_s: float
    focal_rms: float


def skies_of(pixel_rad: float) -> Skies:
    return CachedSkies(CATALOGUE, DAY, pixel_rad, 2.0)


def try_frames(kind: Kind, told: float, flux: bool, n: int, reach: float) -> Tally:
    """Return the tally of n frames, the told focal length `told` times the true one."""
    rng = np.random.default_rng(11)
    seen = seen_stars(hipparcos_at_epoch(kind.magnitude_limit + 1.0), kind)
    offs, right, seconds = [], 0, []
    for k in range(n):
        true = mirrored(kind.camera) if k % 2 else kind.camera
        frame = _frame(kind, seen, k % 2 == 1, flux, rng)
        camera = kind.camera._replace(
            fx_px=kind.camera.fx_px * told, fy_px=kind.camera.fy_px * told
        )
        started = time.process_time()
        found = next(find_cameras([frame], camera, reach, skies_of, HOW), None)
        seconds.append(time.process_time() - started)
        if found is not None:
            offs.append(found.camera.fx_px / true.fx_px - 1)
            right += _is_right(found.camera, true)
    rms = float(np.sqrt(np.mean(np.square(offs)))) if offs else float("nan")
    return Tally(right, len(offs) - right, float(np.median(seconds)), rms)


def _frame(
    kind: Kind, seen: object, is_mirrored: bool, flux: bool, rng: np.random.Generator
) -> ImageFrame:
    R = matrix_from_quaternion(canonical(rng.normal(size=(1, 4))))[0]
    x, y, magnitude, _ = expose(kind, seen, R, 0.3, 3, 0.1, rng)  # type: ignore[arg-type]
    if is_mirrored:
        y = kind.width_px - 1 - y
    unknown: Array = np.full(len(x), np.nan)
    return ImageFrame(x, y, unknown, magnitude if flux else unknown, np.zeros(3))


def _is_right(found: Camera, true: Camera) -> bool:
    return abs(found.fx_px / true.fx_px - 1) < 5e-3 and (found.fy_px < 0) == (true.fy_px < 0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=100)
    parser.add_argument("--reach", type=float, default=1.11)
    parser.add_argument("--told", type=float, nargs="*", default=[0.95, 1.02, 1.09])
    parser.add_argument("--fields", nargs="*", default=[kind.name for kind in KINDS])
    arguments = parser.parse_args()
    print("field deg  told/true  flux  right %  wrong  focal rms  CPU s (median frame)")
    for kind in KINDS:
        for told in arguments.told if kind.name in arguments.fields else []:
            for flux in (True, False):
                t = try_frames(kind, told, flux, arguments.frames, arguments.reach)
                print(
                    f"{kind.field_deg:9.1f}  {told:9.2f}  {'yes' if flux else 'no':>4}"
                    f"  {100 * t.right / arguments.frames:7.1f}  {t.wrong:5d}"
                    f"  {t.focal_rms:9.1e}  {t.cpu_s:.2f}"
                )


if __name__ == "__main__":
    main()

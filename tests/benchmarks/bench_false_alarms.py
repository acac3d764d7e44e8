"""False alarms: how often frames without a star of the catalogue get an attitude from stars.

    python tests/benchmarks/bench_false_alarms.py [WAY ...] [--frames N] [--seconds S]
        [--false-alarm P] [--points LEAST MOST] [--every N] [--seed S]

Each sensor is drawn: field, number of its points and how they lie, centroid error, flux or none.
Ways: `searched`: between frames of stars far apart in time, so that the sensor is known, but not
its attitude. `followed`: between frames a second apart, which have priors, and hardly searched.
`prior`: each frame has a prior attitude. `alone`: sensors without any star, eight frames each.

All goes through `identify_sensor` with the settings of a run. Counted are the frames that were
tried, and attitudes among them, beside the setting, with the upper bound of Poisson's law (95 %).
One frame in N has no stars (2): where most frames of a sensor have stars, less evidence is enough.
Ctrl-C prints what is counted so far.
"""

import argparse
import signal
import time
from collections import defaultdict
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import chi2

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.arrays import Array
from epipole.schemas.settings import Settings
from epipole.tasks.algorithms.geometry.camera import Camera, inside, pixel_angle, project, unproject
from epipole.tasks.algorithms.geometry.directions import (
    matrix_from_quaternion,
    quaternion_from_rotation_vector,
)
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids
from epipole.tasks.algorithms.star_identification.frame import FieldOfView, MatchSettings
from epipole.tasks.algorithms.star_identification.sensor import identify_sensor
from epipole.tasks.algorithms.star_identification.sequence import Priors
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue

Rng = np.random.Generator

# Field [degrees]: faintest star [V].
LIMITS = {2: 9.0, 6: 7.5, 8: 7.0, 12: 6.25, 20: 5.5, 30: 5.0}
LAYOUTS = ("uniform", "clusters", "lines", "hot pixels")
WAYS = ("searched", "followed", "prior", "alone")
WIDTH = 1024
APART_S = {"searched": 1e4, "followed": 1.0, "prior": 1e4, "alone": 1e4}
PRIORS_ARCSEC = (20.0, 60.0, 600.0)
DAY = 19_723
STARLESS = 150  # frames of a sensor without stars, between those with stars
FRAMES_ALONE = 8
SCATTER_MAG = 0.2
TRIED = (None, "no_match", "time_limit", "search_limit")


class Drawn(NamedTuple):
    """A sensor: field [degrees], whether it reports flux, error [px], points, how they lie."""

    field: int
    flux: bool
    sigma_px: float
    points: int
    layout: str

    def kinds(self) -> list[str]:
        """Return the kinds that it is counted in."""
        few = "3 to 5 points" if self.points < 6 else "6 to 15 points"
        return [
            "with flux" if self.flux else "without flux",
            f"{self.field} degrees, {'flux' if self.flux else 'no flux'}",
            few if self.points < 16 else "16 to 60 points",
            "below 0.5 px" if self.sigma_px < 0.5 else "0.5 px and more",
            self.layout,
            "all",
        ]


def draw(rng: Rng, points: tuple[int, int]) -> Drawn:
    """Return a sensor whose frames have so many points, at least and at most."""
    least, most = points
    return Drawn(
        int(rng.choice(list(LIMITS))),
        bool(rng.random() < 0.5),
        float(np.exp(rng.uniform(np.log(0.05), np.log(2.0)))),
        # Few points more often: they are cheap, and deceive.
        int(least * ((most + 1) / least) ** (rng.random() ** 2)),
        str(rng.choice(LAYOUTS)),
    )


class Shooter:
    """Frames of a drawn sensor."""

    def __init__(self, of: Drawn, catalogue: Catalogue, rng: Rng) -> None:
        f = WIDTH / 2 / np.tan(np.radians(of.field) / 2)
        middle = (WIDTH - 1) / 2
        self.of, self.rng = of, rng
        self.camera = Camera(WIDTH, WIDTH, f, f, middle, middle)
        box = np.array([-1, 1, -1, 1]) * WIDTH / 2 / f
        self.optics = FieldOfView(self.camera.half_diagonal_rad, box, self.camera.pixel_rad)
        self.skies = CachedSkies(catalogue, DAY, self.camera.pixel_rad, 2.0)
        self.stars = self.skies.sky(LIMITS[of.field]).catalogue
        self.fixed = self._places(of.points), self._magnitudes(of.points)

    def of_stars(self, R: Array) -> Array:
        """Return x, y [px] and magnitude (3, n) of a frame of stars, a tenth of them missing."""
        near = self.stars.u_icrs @ R[2] > np.cos(self.optics.half_diagonal_rad)
        near &= self.rng.random(len(near)) < 0.9
        x, y = project(self.camera, self.stars.u_icrs[near] @ R.T)
        shown = inside(self.camera, x, y)
        m = self.stars.magnitude[near][shown]
        seen = np.stack([x[shown], y[shown], m + self.rng.normal(0, SCATTER_MAG, len(m))])
        seen[:2] += self.rng.normal(0, self.of.sigma_px, seen[:2].shape)
        return seen

    def starless(self) -> Array:
        """Return the same of a frame without stars."""
        if self.of.layout == "hot pixels":
            places, m = self.fixed
        else:
            places, m = self._places(self.of.points), self._magnitudes(self.of.points)
        return np.vstack([places + self.rng.normal(0, self.of.sigma_px, places.shape), m])

    def _magnitudes(self, n: int) -> Array:
        limit = LIMITS[self.of.field]
        return self.rng.uniform(limit - 3.5, limit, n)

    def _places(self, n: int) -> Array:
        """Return places (2, n) [px]."""
        rng = self.rng
        if self.of.layout == "clusters":
            centre = rng.uniform(100, WIDTH - 100, (2, 3))
            places = centre[:, rng.integers(0, 3, n)] + rng.normal(0, 40, (2, n))
        elif self.of.layout == "lines":
            a, b = rng.uniform(0, WIDTH, (2, 2))
            places = a[:, None] + (b - a)[:, None] * rng.random(n) + rng.normal(0, 1, (2, n))
        else:
            places = rng.uniform(0, WIDTH, (2, n))
        return np.clip(places, 0, WIDTH - 1)

    def centroids(self, frames: list[Array]) -> RawCentroids:
        """Return the frames, brightest centroid first in each."""
        x, y, m = np.hstack([seen[:, np.argsort(seen[2])] for seen in frames])
        first = np.concatenate([[0], np.cumsum([seen.shape[1] for seen in frames])])
        u = unproject(self.camera, x, y)
        n = len(frames)
        return RawCentroids(
            first, u, pixel_angle(self.camera, u), np.full(len(x), self.of.sigma_px),
            m if self.of.flux else np.full(len(x), np.nan), np.zeros((n, 3)), [self.optics],
            np.zeros(n, np.int64),
        )  # fmt: skip


def run_sensor(
    way: str, of: Drawn, every: int, catalogue: Catalogue, matching: MatchSettings, rng: Rng
) -> tuple[int, int]:
    """Return how many of a sensor's frames without stars were tried, and false attitudes."""
    shooter = Shooter(of, catalogue, rng)
    n = FRAMES_ALONE if way == "alone" else STARLESS * every
    starless = np.full(n, True) if way == "alone" else np.arange(n) % every == every - 1
    q = rng.normal(size=(n if APART_S[way] > 1 else 1, 4))
    R = matrix_from_quaternion(q / np.linalg.norm(q, axis=1, keepdims=True))
    if len(R) < n:
        turned = np.outer(np.arange(n), rng.normal(0, 5e-4, 3))
        R = matrix_from_quaternion(quaternion_from_rotation_vector(turned)) @ R[0]
    frames = [shooter.starless() if starless[k] else shooter.of_stars(R[k]) for k in range(n)]
    priors = Priors(np.full((n, 3, 3), np.nan), np.full(n, np.nan))
    if way in ("followed", "prior"):
        sigma = np.radians(rng.choice(PRIORS_ARCSEC) / 3600)
        off = quaternion_from_rotation_vector(rng.normal(0, sigma, (n, 3)))
        priors = Priors(
            matrix_from_quaternion(off) @ R, np.where(starless & (way == "followed"), np.nan, sigma)
        )
    if way == "followed":
        matching = matching._replace(time_limit_s=1e-6, crowded=False)
    t_s = np.arange(n) * APART_S[way]
    found = identify_sensor(t_s, shooter.centroids(frames), priors, shooter.skies, None, matching)
    tried = starless & np.array([way == "followed" or s in TRIED for s in found.status])
    return int(tried.sum()), int((tried & found.solutions.solved).sum())


def count(
    chosen: argparse.Namespace, way: str, catalogue: Catalogue, matching: MatchSettings
) -> None:
    """Print the table of a way."""
    counts: dict[str, Any] = defaultdict(lambda: np.zeros(3, int))
    rng, started = np.random.default_rng([chosen.seed, WAYS.index(way)]), time.process_time()
    try:
        while counts["all"][1] < chosen.frames and time.process_time() - started < chosen.seconds:
            of = draw(rng, chosen.points)
            found = run_sensor(way, of, chosen.every, catalogue, matching, rng)
            for kind in of.kinds():
                counts[kind] += 1, *found
    except KeyboardInterrupt:
        print("\nstopped", end="")
    ms = 1e3 * (time.process_time() - started) / max(counts["all"][1], 1)
    print(f"\n{way}, one frame in {chosen.every} without stars, {ms:.2f} ms of CPU per such frame; "
          f"setting {chosen.false_alarm:g}")  # fmt: skip
    print("| kind | sensors | frames | attitudes | rate | at most, 95 % | that over the setting |")
    print("|---|---|---|---|---|---|---|")
    for kind in sorted(counts, key=_natural):
        print(row(kind, *counts[kind].tolist(), chosen.false_alarm), flush=True)


def row(name: str, sensors: int, tried: int, false: int, setting: float) -> str:
    """Return a row of the table."""
    bound = chi2.ppf(0.95, 2 * (false + 1)) / 2 / max(tried, 1)
    return (
        f"| {name} | {sensors:,} | {tried:,} | {false} | {false / max(tried, 1):.1e} | {bound:.1e} "
        f"| {bound / setting:.1f} |"
    )


def main() -> None:
    """Print a table for each way."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("ways", nargs="*", default=WAYS, metavar="WAY")
    parser.add_argument("--frames", type=int, default=250_000, help="without stars, of each way")
    rule = Settings().identification
    parser.add_argument("--false-alarm", type=float, default=rule.false_alarm, help="the setting")
    parser.add_argument("--seconds", type=float, default=600.0, help="CPU time of each way")
    parser.add_argument("--points", type=int, nargs=2, default=(3, 60), help="in a frame")
    parser.add_argument("--every", type=int, default=2, help="one frame in so many has no stars")
    parser.add_argument("--seed", type=int, default=1)
    chosen = parser.parse_args()
    catalogue = Catalogue(read_hipparcos())
    matching = MatchSettings(
        rule.gate_sigma, -np.log(chosen.false_alarm), rule.time_limit_s, np.nan
    )
    for way in chosen.ways:
        count(chosen, way, catalogue, matching)


def _natural(kind: str) -> tuple[int, str]:
    number = kind.split()[0]
    return (int(number) if number.isdigit() else 0), kind


if __name__ == "__main__":
    # A shell lets its background jobs ignore Ctrl-C.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    main()

"""Crowded frames: a few stars among hundreds of false points as bright as they.

    python tests/benchmarks/bench_crowded_frames.py [--cameras abc] [--false N ...] [--cluster N]
        [--frames N] [--seed S] [--time-limit S]

Sensors at random attitudes without priors, centroid error 0.3 px stated, a tenth of the stars
missing; with brightness and without; through `identify_sensor` with the settings of a run. Right
and wrong as in `bench_star_identification`; right also of the frames with ten stars or more.
"""

import argparse
import time

import numpy as np
from bench_star_identification import judge
from star_frames import KINDS, Kind, expose, hipparcos_at_epoch, seen_stars

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.arrays import Array
from epipole.schemas.settings import IdentificationSettings
from epipole.tasks.algorithms.geometry.camera import pixel_angle, unproject
from epipole.tasks.algorithms.geometry.directions import canonical, matrix_from_quaternion
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids
from epipole.tasks.algorithms.star_identification.frame import FieldOfView, MatchSettings
from epipole.tasks.algorithms.star_identification.sensor import identify_sensor
from epipole.tasks.algorithms.star_identification.sequence import no_priors
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue

Rng = np.random.Generator

DAY = 19_723
SIGMA_PX, MISSING, APART_S = 0.3, 0.1, 1e4
CLUSTER_PX = 20.0
MANY_STARS = 10


def shot(
    kind: Kind, seen: object, R: Array, n_false: int, n_cluster: int, rng: Rng
) -> tuple[Array, int]:
    """Return x, y [px] and magnitude (3, n) of a frame, brightest first, and its stars' number."""
    *shown, star_id = expose(kind, seen, R, SIGMA_PX, n_false, MISSING, rng)
    points = np.stack(shown)
    centre = rng.uniform(0.1, 0.9, (2, 1)) * kind.width_px
    places = centre + rng.normal(0, CLUSTER_PX, (2, n_cluster))
    limit = kind.magnitude_limit
    points = np.hstack([points, np.vstack([places, rng.uniform(limit - 3.5, limit, n_cluster)])])
    return points[:, np.argsort(points[2])], int(np.sum(star_id >= 0))


def centroids(kind: Kind, shots: list[Array], flux: bool) -> RawCentroids:
    """Return the frames as a sensor's."""
    camera = kind.camera
    x, y, magnitude = np.hstack(shots)
    first = np.concatenate([[0], np.cumsum([points.shape[1] for points in shots])])
    u, half = unproject(camera, x, y), kind.width_px / 2 / camera.fx_px
    box = np.array([-half, half, -half, half])
    return RawCentroids(
        first, u, pixel_angle(camera, u), np.full(len(x), SIGMA_PX),
        magnitude if flux else np.full(len(x), np.nan), np.zeros((len(shots), 3)),
        [FieldOfView(camera.half_diagonal_rad, box, camera.pixel_rad)],
        np.zeros(len(shots), np.int64),
    )  # fmt: skip


def measure(
    kind: Kind,
    n_false: int,
    n_cluster: int,
    n: int,
    flux: bool,
    rng: Rng,
    rule: IdentificationSettings,
) -> str:
    """Return a row of the table."""
    catalogue = Catalogue(read_hipparcos())
    skies = CachedSkies(catalogue, DAY, kind.camera.pixel_rad, 2.0)
    matching = MatchSettings(rule.gate_sigma, -np.log(rule.false_alarm), rule.time_limit_s, np.nan)
    seen = seen_stars(hipparcos_at_epoch(kind.magnitude_limit + 1.0), kind)
    R = matrix_from_quaternion(canonical(rng.normal(size=(n, 4))))
    shots, stars = zip(*[shot(kind, seen, one, n_false, n_cluster, rng) for one in R], strict=True)
    raw = centroids(kind, list(shots), flux)
    start = time.process_time()
    found = identify_sensor(np.arange(n) * APART_S, raw, no_priors(n), skies, None, matching)
    ms = 1e3 * (time.process_time() - start) / n
    answers = [s and s.R_sensor_from_icrs for s in found.solutions.each()]
    right, wrong = np.array([judge(a, b) for a, b in zip(answers, R, strict=True)]).T
    skipped = sum(found.status.count(name) for name in ("not_searched", "search_limit"))
    many = right[np.array(stars) >= MANY_STARS]
    of_many = f"{100 * np.sum(many) / max(len(many), 1):.0f} of {len(many)}"
    return f"{100 * right.mean():.0f} | {of_many} | {wrong.sum()} | {skipped} | {ms:.0f}"


def main() -> None:
    """Print a row for each crowd, with brightness and without."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--cameras", default="abc")
    options.add_argument("--false", type=int, nargs="*", default=[3, 500, 970])
    options.add_argument("--cluster", type=int, default=200, help="points in one; 0: no such row")
    options.add_argument("--frames", type=int, default=48)
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--time-limit", type=float, help="`identification.time_limit_s`")
    given = options.parse_args()
    limit = {} if given.time_limit is None else {"time_limit_s": given.time_limit}
    rule = IdentificationSettings(**limit)
    crowds = [(n, 0) for n in given.false] + [(3, given.cluster)] * (given.cluster > 0)
    print(
        "| camera | false | cluster | flux | right % | with ten stars | wrong | not searched "
        "| CPU ms per frame |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for name in given.cameras:
        for crowd in crowds:
            for flux in (True, False):
                rng = np.random.default_rng([given.seed, *crowd])
                said = measure(KINDS[name], *crowd, given.frames, flux, rng, rule)
                print(f"| {name} | {crowd[0]} | {crowd[1]} | {flux} | {said} |", flush=True)


if __name__ == "__main__":
    main()

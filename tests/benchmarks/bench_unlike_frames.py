"""Frames that are unlike the sensor's others: worse, brighter, with spots that stay, with priors
that go wrong, or the only ones that show the sky.

    python tests/benchmarks/bench_unlike_frames.py [--cameras abc] [--kinds KIND ...] [--frames N]
        [--seed S]

Sensors of frames at random attitudes without priors, unless said, centroid error 0.15 px, 3 false
points, 5 % of the stars missing; through `identify_sensor` with the settings of a run. Printed per
camera, kind, and which error is stated (none, 0.15 px, or that of the photons alone: 0.15 px at
the limit and less for brighter stars): frames identified of those that show the
sky, wrong ones of all, and the mean squared error of attitudes over covariance across the boresight
and about it; for kind `errors` by the frames' centroid error.
"""

import argparse
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from bench_crowded_frames import APART_S, DAY
from bench_star_identification import judge
from star_frames import KINDS, Kind, expose, hipparcos_at_epoch, seen_stars

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.arrays import Array, Flags
from epipole.schemas.settings import Settings
from epipole.tasks.algorithms.geometry.camera import pixel_angle, unproject
from epipole.tasks.algorithms.geometry.directions import (
    canonical,
    matrix_from_quaternion,
    quaternion_from_rotation_vector,
)
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids
from epipole.tasks.algorithms.star_identification.frame import FieldOfView, MatchSettings
from epipole.tasks.algorithms.star_identification.sensor import identify_sensor
from epipole.tasks.algorithms.star_identification.sequence import Priors, no_priors
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue

Rng = np.random.Generator

SIGMA_PX, FALSE, MISSING = 0.15, 3, 0.05
SHAKEN_PX, SHAKEN_EACH = 1.0, 4  # one frame in so many
BRIGHTER_MAG = 1.5  # every second frame, exposed longer
STAYS, FRAMES_PER_POINTING = 5, 3
DRIFT_ARCSEC, STATED_ARCSEC = 650.0, 20.0
SKY_EACH, CLUTTER = 3, 30
ERRORS_PX = (0.0, 0.5, 1.0, 2.0)
ARCSEC = np.pi / 648000


class Scene(NamedTuple):
    """A sensor's frames: x, y [px] and magnitude of each, (3, n), brightest first; attitudes
    (F, 3, 3); centroid errors (F,) [px]; which show the sky (F,); its priors."""

    shots: list[Array]
    R: Array
    sigma_px: Array
    sky: Flags
    priors: Priors


class Stars(NamedTuple):
    """A camera, and the stars that it resolves."""

    kind: Kind
    seen: object


def _scene(
    stars: Stars, n: int, rng: Rng, R: Array | None = None, sigma_px: object = SIGMA_PX
) -> Scene:
    R = matrix_from_quaternion(canonical(rng.normal(size=(n, 4)))) if R is None else R
    sigma = np.broadcast_to(np.asarray(sigma_px, float), n)
    shots = [np.stack(expose(*stars, R[k], sigma[k], FALSE, MISSING, rng)[:3]) for k in range(n)]
    return Scene(shots, R, sigma, np.ones(n, bool), no_priors(n))


def like_the_others(stars: Stars, n: int, rng: Rng) -> Scene:
    return _scene(stars, n, rng)


def errors(stars: Stars, n: int, rng: Rng) -> Scene:
    return _scene(stars, n, rng, sigma_px=rng.choice(ERRORS_PX, n))


def shaken(stars: Stars, n: int, rng: Rng) -> Scene:
    return _scene(stars, n, rng, sigma_px=np.where(np.arange(n) % SHAKEN_EACH, SIGMA_PX, SHAKEN_PX))


def exposed_longer(stars: Stars, n: int, rng: Rng) -> Scene:
    scene = _scene(stars, n, rng)
    for points in scene.shots[::2]:
        points[2] -= BRIGHTER_MAG
    return scene


def spots_that_stay(stars: Stars, n: int, rng: Rng) -> Scene:
    pointing = matrix_from_quaternion(canonical(rng.normal(size=(n, 4))))
    R = pointing[np.arange(n) // FRAMES_PER_POINTING]
    step = quaternion_from_rotation_vector(np.array([[0.0, 0.0, 1e-3]]))
    scene = _scene(stars, n, rng, R=matrix_from_quaternion(step) @ R)
    for k in range(FRAMES_PER_POINTING, n, FRAMES_PER_POINTING):
        both = np.hstack([scene.shots[k - 1][:, :STAYS], scene.shots[k]])
        scene.shots[k] = both[:, np.argsort(both[2])]
    return scene


def drifting_priors(stars: Stars, n: int, rng: Rng) -> Scene:
    scene = _scene(stars, n, rng)
    off = np.outer(np.linspace(0, DRIFT_ARCSEC, n) * ARCSEC, [0.8, 0.6, 0.0])
    wrong = matrix_from_quaternion(quaternion_from_rotation_vector(off)) @ scene.R
    return scene._replace(priors=Priors(wrong, np.full(n, STATED_ARCSEC * ARCSEC)))


def sky_in_few(stars: Stars, n: int, rng: Rng) -> Scene:
    scene = _scene(stars, n, rng)
    sky = np.arange(n) % SKY_EACH == SKY_EACH // 2
    kind = stars.kind
    for k in np.flatnonzero(~sky):
        limit = kind.magnitude_limit
        scene.shots[k] = np.vstack(
            [rng.uniform(0, kind.width_px - 1, (2, CLUTTER)),
             np.sort(rng.uniform(limit - 3.5, limit, CLUTTER))]
        )  # fmt: skip
    return scene._replace(sky=sky)


SCENES: dict[str, Callable[[Stars, int, Rng], Scene]] = {
    "like the others": like_the_others,
    "errors": errors,
    "shaken": shaken,
    "exposed longer": exposed_longer,
    "spots that stay": spots_that_stay,
    "drifting priors": drifting_priors,
    "sky in few": sky_in_few,
}

STATED = {"like the others": ("none", "true", "photons"), "errors": ("none",)}


def centroids(kind: Kind, shots: list[Array], stated: str) -> RawCentroids:
    """Return the frames as a sensor's."""
    camera = kind.camera
    x, y, magnitude = np.hstack(shots)
    first = np.concatenate([[0], np.cumsum([points.shape[1] for points in shots])])
    u, half = unproject(camera, x, y), kind.width_px / 2 / camera.fx_px
    photons_px = SIGMA_PX * np.minimum(10.0 ** (0.2 * (magnitude - kind.magnitude_limit)), 1.0)
    stated_px = {"photons": photons_px, "true": np.full(len(x), SIGMA_PX)}
    return RawCentroids(
        first, u, pixel_angle(camera, u), stated_px.get(stated, np.full(len(x), np.nan)),
        magnitude, np.zeros((len(shots), 3)),
        [FieldOfView(camera.half_diagonal_rad, np.array([-half, half, -half, half]),
                     camera.pixel_rad)],
        np.zeros(len(shots), np.int64),
    )  # fmt: skip


def squares(R: Array, true: Array, cov: Array) -> tuple[float, float]:
    """Return the squared error over variance across the boresight (mean of both axes) and about
    it."""
    turn = R @ true.T
    off = 0.5 * np.array(
        [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]]
    )
    x, y, z = off**2 / np.diagonal(cov)
    return 0.5 * (x + y), z


def measure(kind: Kind, scene: Scene, stated: str) -> list[str]:
    """Return rows of the table, one for each centroid error."""
    skies = CachedSkies(Catalogue(read_hipparcos()), DAY, kind.camera.pixel_rad, 2.0)
    rule, n = Settings().identification, len(scene.shots)
    matching = MatchSettings(rule.gate_sigma, -np.log(rule.false_alarm), rule.time_limit_s, np.nan)
    t_s, raw = np.arange(n) * APART_S, centroids(kind, scene.shots, stated)
    found = identify_sensor(t_s, raw, scene.priors, skies, None, matching).solutions
    answers = [found.R_sensor_from_icrs[k] if found.solved[k] else None for k in range(n)]
    wrong = np.array([judge(a, b)[1] for a, b in zip(answers, scene.R, strict=True)])
    rows = []
    for sigma in np.unique(scene.sigma_px[scene.sky]):
        of = scene.sky & (scene.sigma_px == sigma)
        right = np.flatnonzero(of & found.solved & ~wrong)
        z2 = np.array([squares(found.R_sensor_from_icrs[k], scene.R[k], found.cov_rad2[k])
                       for k in right])  # fmt: skip
        across, about = z2.mean(axis=0) if len(z2) else (np.nan, np.nan)
        rows.append(f"{sigma:g} | {100 * found.solved[of].mean():.1f} | {wrong.sum()} "
                    f"| {across:.2f} | {about:.2f}")  # fmt: skip
    return rows


def main() -> None:
    """Print a row for each camera, kind, and centroid error."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--cameras", default="ac")
    options.add_argument("--kinds", nargs="+", choices=SCENES, default=list(SCENES))
    options.add_argument("--frames", type=int, default=120)
    options.add_argument("--seed", type=int, default=1)
    given = options.parse_args()
    print("| camera | kind | stated | error px | identified % | wrong | across | about |")
    print("|---|---|---|---|---|---|---|---|")
    for name in given.cameras:
        kind = KINDS[name]
        stars = Stars(kind, seen_stars(hipparcos_at_epoch(kind.magnitude_limit + 1.0), kind))
        for label in given.kinds:
            for stated in STATED.get(label, ("none", "true")):
                rng = np.random.default_rng([given.seed, list(SCENES).index(label)])
                for row in measure(kind, SCENES[label](stars, given.frames, rng), stated):
                    print(f"| {name} | {label} | {stated} | {row} |", flush=True)


if __name__ == "__main__":
    main()

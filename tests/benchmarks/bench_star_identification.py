"""Star identification: right and wrong answers, and CPU time, beside public tools.

    python tests/benchmarks/bench_star_identification.py [--made N] [--cameras abc] [--no-peers]

Frames: the 36 cells (centroid error 0 to 2 px, 0 to 10 false stars, 0 to 40 % missing) of
three cameras, from ../shared/data/starid where it is there, else made here; with --made, N
frames a camera are made from Hipparcos. Every solver gets the same frames, one by one, and
is told the camera and the centroid error. Right: boresight within 0.05 degrees and roll
within 0.5; wrong: an answer whose boresight is more than 0.25 degrees off, or its roll 5.
Public tools: `pip install --group bench`.
"""

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import gettempdir
from typing import NamedTuple

import numpy as np
from star_frames import (
    CELLS,
    MERGED_PX,
    Frames,
    expose,
    make_frames,
    read_frames,
    seen_stars,
)
from star_peers import Solver, cedar_solve, tetra3rs

from epipole.schemas.arrays import Array, Flags
from epipole.schemas.settings import Settings
from epipole.tasks.algorithms.geometry.camera import pixel_angle, unproject
from epipole.tasks.algorithms.geometry.directions import (
    matrix_from_quaternion,
    quaternion_from_rotation_vector,
)
from epipole.tasks.algorithms.star_catalogue import navigation_catalogue
from epipole.tasks.algorithms.star_identification.centroids import SensorCentroids
from epipole.tasks.algorithms.star_identification.frame import (
    FieldOfView,
    FrameCentroids,
    MatchSettings,
    search_frame,
)
from epipole.tasks.algorithms.star_identification.published import (
    four_base_stars,
    match_group,
    radial_cyclic,
)
from epipole.tasks.algorithms.star_identification.published.common import Matcher, solve_matches
from epipole.tasks.algorithms.star_identification.sequence import identify_sequence, no_priors
from epipole.tasks.algorithms.star_identification.star_grid import (
    Sky,
    pattern_pairs,
    pattern_size,
    sky_grid,
    sky_to_limit,
)

SHARED = Path(__file__).parents[3] / "shared" / "data" / "starid"
RIGHT_DEG, RIGHT_ROLL_DEG, WRONG_DEG = 0.05, 0.5, 0.25
WRONG_ROLL_DEG = 5.0  # three right stars at 2 px may leave a degree or two
FALSE_ALARM = Settings().identification.false_alarm
MIN_SIGMA_PX = 0.05  # stated where there is none
PUBLISHED = {
    "four_base_stars": four_base_stars.make_matcher,
    "match_group": match_group.make_matcher,
    "radial_cyclic": radial_cyclic.make_matcher,
}


class Ours:
    """One camera in this project's terms: sky, field of view, rule of search."""

    def __init__(self, frames: Frames, false_alarm: float = FALSE_ALARM) -> None:
        self.kind = kind = frames.kind
        self.camera = kind.camera
        half = kind.width_px / 2 / self.camera.fx_px
        box = np.array([-half, half, -half, half])
        self.optics = FieldOfView(self.camera.half_diagonal_rad, box, self.camera.pixel_rad)
        merged = navigation_catalogue(*frames.stars, MERGED_PX * self.camera.pixel_rad)
        self.sky: Sky = sky_to_limit(merged, kind.magnitude_limit)
        self.matching = MatchSettings(3.7, -np.log(false_alarm), 0.5, np.nan)
        self.solved, self.refused = 0, 0
        n = pattern_size(self.sky, self.optics.solid_angle_sr)
        self.pairs = pattern_pairs(self.sky.catalogue.u_icrs[:n], 2 * self.optics.half_diagonal_rad)
        sigmas = [2.0 ** (k / 2) for k in range(-9, 4)]
        self.grids = {
            s: sky_grid(self.sky, 2.5 * self.matching.gate_sigma * s * self.optics.pixel_rad)
            for s in sigmas
        }

    def frame(self, x_px: Array, y_px: Array, mag: Array, sigma_px: float) -> FrameCentroids:
        u = unproject(self.camera, x_px, y_px)
        sigma_rad = max(sigma_px, MIN_SIGMA_PX) * pixel_angle(self.camera, u)
        return FrameCentroids(u, sigma_rad, mag, np.zeros(3), self.optics)

    def default(self, x_px: Array, y_px: Array, mag: Array, sigma_px: float) -> Array | None:
        seen = self.frame(x_px, y_px, mag, sigma_px)
        grid = next(g for s, g in self.grids.items() if s >= max(sigma_px, MIN_SIGMA_PX))
        # As in a run: the odds that a frame shows stars are those of the frames before.
        matching = self.matching._replace(
            starlit=float(np.log((self.solved + 1) / (self.refused + 1)))
        )
        found = search_frame(seen, self.sky, grid, self.pairs, matching).solution
        self.solved, self.refused = self.solved + bool(found), self.refused + (not found)
        return found and found.R_sensor_from_icrs

    def without_brightness(
        self, x_px: Array, y_px: Array, mag: Array, sigma_px: float
    ) -> Array | None:
        return self.default(x_px, y_px, np.full(len(mag), np.nan), sigma_px)

    def published(self, make_matcher: Callable[[Sky, FieldOfView], Matcher]) -> Solver:
        sky = sky_to_limit(self.sky.catalogue, self.kind.magnitude_limit)
        match = make_matcher(sky, self.optics)

        def solve(x_px: Array, y_px: Array, mag: Array, sigma_px: float) -> Array | None:
            seen = self.frame(x_px, y_px, mag, sigma_px)
            star = match(seen.u, seen.sigma_rad)
            found = solve_matches(seen, self.sky, star, self.matching.gate_sigma)
            return found and found.R_sensor_from_icrs

        return solve


class Row(NamedTuple):
    """A solver's results: right and wrong for each frame, CPU milliseconds."""

    right: Flags
    wrong: Flags
    ms: Array

    def text(self, name: str) -> str:
        median, last = np.percentile(self.ms, [50, 99])
        right, wrong = 100 * self.right.mean(), 100 * self.wrong.mean()
        return f"| {name} | {right:.2f} | {wrong:.2f} | {median:.3g} | {last:.3g} |"


def judge(R: Array | None, true: Array) -> tuple[bool, bool]:
    """Return whether an answer is right, and whether it is wrong."""
    if R is None:
        return False, False
    off = np.degrees(np.arctan2(np.linalg.norm(np.cross(R[2], true[2])), R[2] @ true[2]))
    turn = R @ true.T
    roll = abs(np.degrees(np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])))
    return (
        bool(off < RIGHT_DEG and roll < RIGHT_ROLL_DEG),
        bool(off > WRONG_DEG or roll > WRONG_ROLL_DEG),
    )


def run(solve: Solver, frames: Frames) -> Row:
    right, wrong = np.zeros((2, len(frames.cell)), bool)
    ms = np.empty(len(frames.cell))
    for warm in range(3):  # compiled, caches filled
        solve(*centroids(frames, warm))
    for k in range(len(frames.cell)):
        given = centroids(frames, k)
        start = time.process_time()
        R = solve(*given)
        ms[k] = 1e3 * (time.process_time() - start)
        right[k], wrong[k] = judge(R, frames.R_sensor_from_icrs[k])
    return Row(right, wrong, ms)


def centroids(frames: Frames, k: int) -> tuple[Array, Array, Array, float]:
    rows = slice(frames.offset[k], frames.offset[k + 1])
    return frames.x_px[rows], frames.y_px[rows], frames.mag[rows], CELLS[frames.cell[k]][0]


def solvers(
    frames: Frames, cache: Path, peers: bool, false_alarm: float
) -> dict[str, Callable[[], Solver | None]]:
    """Return a function that makes each solver, by name."""
    ours = Ours(frames, false_alarm)
    made: dict[str, Callable[[], Solver | None]] = {
        "epipole": lambda: ours.default,
        "epipole, no brightness": lambda: Ours(frames, false_alarm).without_brightness,
    }
    for name, make_matcher in PUBLISHED.items():
        made[f"published: {name}"] = partial(ours.published, make_matcher)
    if peers:
        made["tetra3rs, error told"] = lambda: tetra3rs(frames, cache, error_told=True)
        made["tetra3rs, defaults"] = lambda: tetra3rs(frames, cache, error_told=False)
        made["cedar-solve, error told"] = lambda: cedar_solve(frames, cache)
    return made


def tracking_us(frames: Frames, n_frames: int) -> tuple[float, float, int]:
    """Return CPU microseconds per frame of a sensor that is followed, centroids per frame, and the
    number of frames that were lost: some have two stars.

    It turns evenly, sees 90 % of its stars to 0.2 px, and 3 false points.
    """
    ours, kind, rng = Ours(frames), frames.kind, np.random.default_rng(0)
    seen, R = seen_stars(frames.stars, kind), frames.R_sensor_from_icrs[0]
    turned = quaternion_from_rotation_vector(
        np.outer(np.arange(n_frames), np.radians([0.03, 0.05, 0.01]))
    )
    attitudes = matrix_from_quaternion(turned) @ R
    shots = [expose(kind, seen, one, 0.2, 3, 0.1, rng)[:3] for one in attitudes]
    each = [ours.frame(x, y, mag, 0.2) for x, y, mag in shots]
    first = np.concatenate([[0], np.cumsum([len(f.u) for f in each])]).astype(np.int64)
    flat = SensorCentroids(
        first, np.concatenate([f.u for f in each]), np.concatenate([f.sigma_rad for f in each]),
        np.concatenate([f.instrumental_mag for f in each]), np.zeros((n_frames, 3)),
        [ours.optics], np.zeros(n_frames, np.int64),
    )  # fmt: skip
    matching, t_s = ours.matching._replace(zero_point_mag=0.0), np.arange(n_frames) * 1.0
    grid, none = next(iter(ours.grids.values())), no_priors(n_frames)
    spent = []
    for _ in range(4):
        start = time.process_time()
        found, _ = identify_sequence(t_s, flat, none, ours.sky, grid, lambda: ours.pairs, matching)
        spent.append(time.process_time() - start)
    lost = int(np.sum(~found.solved))
    return 1e6 * float(np.median(spent[1:])) / n_frames, first[-1] / n_frames, lost


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--made", type=int, metavar="N", help="make N frames a camera")
    options.add_argument("--seed", type=int, default=1)
    options.add_argument("--cameras", default="abc")
    options.add_argument("--no-peers", action="store_true")
    options.add_argument("--only", default="", help="solvers whose names contain this")
    options.add_argument("--cells", action="store_true", help="right %% by cell as well")
    options.add_argument("--false-alarm", type=float, default=FALSE_ALARM, help="the setting")
    options.add_argument("--tracked", type=int, default=20_000, help="frames that are followed")
    given = options.parse_args()
    cache = Path(gettempdir()) / "epipole-bench"
    cache.mkdir(exist_ok=True)
    for name in given.cameras:
        if given.made or not SHARED.is_dir():
            n = given.made or 5 * len(CELLS)
            frames = make_frames(name, np.arange(n) % len(CELLS), given.seed)
        else:
            frames = read_frames(SHARED, name)
        kind = frames.kind
        print(f"\nCamera {name}: {kind.field_deg:g} degrees, {kind.width_px} px, stars to "
              f"{kind.magnitude_limit:g}, {len(frames.cell):,} frames")  # fmt: skip
        print("| | right % | wrong % | CPU ms, median | 99th percentile |")
        print("|---|---|---|---|---|")
        for label, make in solvers(frames, cache, not given.no_peers, given.false_alarm).items():
            if given.only not in label:
                continue
            solve = make()
            if solve is None:
                print(f"| {label} | not installed | | | |")
                continue
            row = run(solve, frames)
            print(row.text(label), flush=True)
            if given.cells:
                print_cells(row, frames)
        if given.only in "tracking":
            us, centroids_a_frame, lost = tracking_us(frames, given.tracked)
            print(f"tracking, {centroids_a_frame:.1f} centroids: {us:.1f} CPU us a frame, "
                  f"{lost} of {given.tracked:,} lost")  # fmt: skip


def print_cells(row: Row, frames: Frames) -> None:
    for cell, (sigma_px, n_false, missing) in enumerate(CELLS):
        at = frames.cell == cell
        print(f"    {sigma_px:g} px, {n_false} false, {missing:.0%} missing: right "
              f"{100 * row.right[at].mean():.1f} %, wrong {row.wrong[at].sum()}")  # fmt: skip


if __name__ == "__main__":
    main()

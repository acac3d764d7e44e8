"""Hostile logs: what a frame costs that no search can identify, or that hides its stars.

    python tests/benchmarks/bench_hostile_logs.py [KIND ...] [--fields DEGREES ...]
        [--frames N ...] [--stop SECONDS] [--seed S]

Each log is one sensor's, without priors, through `identify_stars` with the settings of a run:
`lines` and `comets` of spots, 5,000 `points` that are no stars, `bursts` of 40 points between
frames with stars, `mirrored` fields, a `lost` sensor whose later frames show none of their stars
but 300 other points, and two kinds that have to be identified: `dense` frames (3,000 detections:
hot pixels, stars fainter than the catalogue's, and the stars) and `crowded` ones (970 points as
bright as the stars). With brightness and without. The CPU time is that of a log over its frames,
and that of a log of one frame; it should be below 50 ms and 0.5 s. The catalogue's tables, which
sensors share, are made before. Wrong: a frame without stars, or with an attitude more than 0.25
degrees off.
"""

import argparse
import signal
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa
from star_frames import hipparcos_at_epoch

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.arrays import Array
from epipole.schemas.bridge import array, stack
from epipole.schemas.settings import IdentificationSettings, Settings
from epipole.schemas.work_tables import CAMERAS, EXPOSURES, SENSOR_STATES_AT_FRAMES
from epipole.tasks.algorithms.geometry.camera import Camera, inside, project
from epipole.tasks.algorithms.geometry.directions import canonical, matrix_from_quaternion
from epipole.tasks.algorithms.star_catalogue import NavigationCatalogue
from epipole.tasks.identify.identify_stars import identify_stars

Rng = np.random.Generator

# Field [degrees]: faintest star [V].
LIMITS = {8.0: 7.0, 13.2: 6.5, 20.0: 5.5}
WIDTH, SIGMA_PX, MISSING, SCATTER_MAG = 1024, 0.3, 0.1, 0.2
START_NS, APART_NS = 1_719_792_000_000_000_000, 1_000_000_000
DENSE, CROWD = 3000, 970
MS_PER_FRAME, MS_AT_ONCE = 50.0, 500.0
WRONG_DEG = 0.25


class Shot(NamedTuple):
    """A frame: x, y [px] and magnitude (3, n); its attitude, None where it shows no stars."""

    points: Array
    R: Array | None


class Sensor:
    """A camera, its stars, and what its frames show."""

    def __init__(self, field_deg: float, rng: Rng) -> None:
        f = WIDTH / 2 / np.tan(np.radians(field_deg) / 2)
        middle = (WIDTH - 1) / 2
        self.camera = Camera(WIDTH, WIDTH, f, f, middle, middle)
        self.limit, self.rng = LIMITS[field_deg], rng
        self.stars = hipparcos_at_epoch(self.limit + 3.0)
        self.hot = np.vstack([self.anywhere(DENSE // 3), self.brightness(DENSE // 3, 3.0)])
        self.R = self.attitude()

    def attitude(self) -> Array:
        return matrix_from_quaternion(canonical(self.rng.normal(size=4)))

    def anywhere(self, n: int) -> Array:
        return self.rng.uniform(0, WIDTH - 1, (2, n))

    def brightness(self, n: int, fainter: float = 0.0) -> Array:
        """Return magnitudes about the faintest star, a few of them bright."""
        return self.limit + fainter - 0.5 + np.log10(self.rng.uniform(1e-3, 1, n)) / 0.5

    def random(self, n: int, fainter: float = 0.0) -> Array:
        return np.vstack([self.anywhere(n), self.brightness(n, fainter)])

    def of_stars(self, R: Array, deeper: float = 0.0) -> Array:
        return self.seen(self.stars, R, self.limit + deeper)

    def seen(self, stars: NavigationCatalogue, R: Array, limit: float) -> Array:
        n = np.searchsorted(stars.magnitude, limit)
        near = np.flatnonzero(stars.u_icrs[:n] @ R[2] > np.cos(self.camera.half_diagonal_rad))
        near = near[self.rng.random(len(near)) >= MISSING]
        x, y = project(self.camera, stars.u_icrs[near] @ R.T)
        at = inside(self.camera, x, y)
        m = stars.magnitude[near][at]
        m = m + self.rng.normal(0, SCATTER_MAG, len(m))
        return np.vstack([np.stack([x[at], y[at]]) + self.rng.normal(0, SIGMA_PX, (2, len(m))), m])


def lines(s: Sensor, k: int) -> Shot:
    n, rng = int(s.rng.integers(5, 120)), s.rng
    a, b = rng.uniform(0, WIDTH, (2, 2))
    at = a[:, None] + (b - a)[:, None] * np.linspace(0, 1, n) + rng.normal(0, 0.5, (2, n))
    return Shot(np.vstack([at, s.brightness(n)]), None)


def comets(s: Sensor, k: int) -> Shot:
    """Return three heads with tails."""
    n, rng = int(s.rng.integers(30, 400)), s.rng
    head, tail = rng.uniform(100, WIDTH - 100, (2, 3)), rng.uniform(-200, 200, (2, 3))
    of, far = rng.integers(0, 3, n), rng.exponential(0.3, n)
    at = head[:, of] + tail[:, of] * far + rng.normal(0, 5, (2, n)) * (1 + far)
    return Shot(np.vstack([np.clip(at, 0, WIDTH - 1), s.brightness(n) - 2 + 4 * far]), None)


def points(s: Sensor, k: int) -> Shot:
    return Shot(s.random(5000, 3.0), None)


def bursts(s: Sensor, k: int) -> Shot:
    if k % 8 >= 2:
        return Shot(s.random(40), None)
    R = s.attitude()
    return Shot(s.of_stars(R), R)


def mirrored(s: Sensor, k: int) -> Shot:
    seen = s.of_stars(s.attitude())
    seen[0] = WIDTH - 1 - seen[0]
    return Shot(seen, None)


def lost(s: Sensor, k: int) -> Shot:
    if k >= 20:
        return Shot(s.random(300), None)
    R = s.attitude()
    return Shot(s.of_stars(R), R)


def dense(s: Sensor, k: int) -> Shot:
    R, on = s.attitude(), s.rng.random(s.hot.shape[1]) < 0.9
    hot = s.hot[:, on] + s.rng.normal(0, 0.05, (3, on.sum()))
    seen = np.hstack([s.of_stars(R, 2.0), hot])
    return Shot(np.hstack([seen, s.random(DENSE - seen.shape[1], 3.0)]), R)


def crowded(s: Sensor, k: int) -> Shot:
    R, m = s.attitude(), s.rng.uniform(s.limit - 3.5, s.limit, CROWD)
    return Shot(np.hstack([s.of_stars(R), np.vstack([s.anywhere(CROWD), m])]), R)


KINDS: dict[str, Callable[[Sensor, int], Shot]] = {
    kind.__name__: kind
    for kind in (lines, comets, points, bursts, mirrored, lost, dense, crowded)
}  # fmt: skip


def exposures(shots: list[Shot], flux: bool) -> pa.Table:
    """Return EXPOSURES of the frames; their errors are not stated."""
    each = [shot.points for shot in shots]
    values: dict[str, Any] = {
        "sensor_id": ["s"] * len(shots),
        "frame_number": np.arange(len(shots)),
        "time": START_NS + APART_NS * np.arange(len(shots)),
        "exposure_s": np.full(len(shots), 0.1),
        "x_px": [p[0] for p in each],
        "y_px": [p[1] for p in each],
        "flux": [10 ** (-0.4 * (p[2] - 15)) if flux else None for p in each],
        "sigma_px": [None] * len(shots),
        "source": ["log"] * len(shots),
        "offset": [None] * len(shots),
    }
    return pa.table([pa.array(values[f.name], f.type) for f in EXPOSURES], schema=EXPOSURES)


def states(frames: pa.Table) -> pa.Table:
    """Return the states at the frames: all unknown."""
    columns = [
        frames[f.name].combine_chunks()
        if f.name in ("sensor_id", "frame_number", "time")
        else pa.nulls(frames.num_rows, f.type)
        for f in SENSOR_STATES_AT_FRAMES
    ]
    return pa.table(columns, schema=SENSOR_STATES_AT_FRAMES)


def camera_table(camera: Camera) -> pa.Table:
    values: dict[str, Any] = {"sensor_id": "s", "time": START_NS} | camera._asdict()
    columns = [pa.array([values.get(f.name, 0.0)], f.type) for f in CAMERAS]
    return pa.table(columns, schema=CAMERAS)


class Log(NamedTuple):
    """A hostile log: its frames, their camera, and what is true of them."""

    shots: list[Shot]
    camera: Camera
    flux: bool

    def identify(self, rule: IdentificationSettings) -> tuple[pa.Table, float]:
        """Return SOLUTIONS, and the CPU time [s]."""
        frames, settings = exposures(self.shots, self.flux), Settings()
        stars = read_hipparcos()
        started = time.process_time()
        found = identify_stars(
            frames, states(frames), camera_table(self.camera), stars, settings.sensors,
            rule, settings.tracklets.max_detections,
        )  # fmt: skip
        return found.solutions, time.process_time() - started

    def judged(self, solutions: pa.Table) -> tuple[int, int, int]:
        """Return frames with stars, and right and wrong attitudes."""
        solved = array(solutions, "attitude_source") == "stars"
        R = matrix_from_quaternion(stack(solutions, "q{}", "xyzw"))
        right = wrong = 0
        for k in np.flatnonzero(solved):
            true = self.shots[k].R
            off = 9.9 if true is None else np.degrees(np.arccos(np.clip(R[k, 2] @ true[2], -1, 1)))
            right, wrong = right + (off < WRONG_DEG), wrong + (off >= WRONG_DEG)
        return sum(shot.R is not None for shot in self.shots), right, wrong


def make_log(kind: str, field_deg: float, n: int, flux: bool, seed: int) -> Log:
    """Return a log of n frames, the same for the same arguments."""
    rng = np.random.default_rng([seed, list(KINDS).index(kind), int(10 * field_deg)])
    sensor = Sensor(field_deg, rng)
    shots = [KINDS[kind](sensor, k) for k in range(n)]
    mixed = [shot._replace(points=rng.permutation(shot.points, axis=1)) for shot in shots]
    return Log(mixed, sensor.camera, flux)


def stopped(seconds: float, run: Callable[[], Any]) -> Any:
    """Return what `run` returns, None after so much CPU time."""

    def stop(*_: object) -> None:
        raise TimeoutError

    signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        return run()
    except TimeoutError:
        return None
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)


def row(name: str, log: Log, rule: IdentificationSettings, stop_s: float) -> str:
    """Return a row of the table."""
    stopped(stop_s, lambda: log.identify(rule))  # makes the tables, compiles
    said = stopped(stop_s, lambda: log.identify(rule))
    n = len(log.shots)
    if said is None:
        return f"| {name} | {n} | > {1e3 * stop_s / n:.0f} | stopped | | | |"
    solutions, seconds = said
    shown, right, wrong = log.judged(solutions)
    limited = np.sum(array(solutions, "status") == "search_limit")
    return f"| {name} | {n} | {1e3 * seconds / n:.1f} | {shown} | {right} | {wrong} | {limited} |"


def main() -> None:
    """Print a row for each log."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("kinds", nargs="*", default=list(KINDS), metavar="KIND")
    options.add_argument("--fields", type=float, nargs="*", default=list(LIMITS))
    options.add_argument("--frames", type=int, nargs="*", default=[1, 60])
    options.add_argument("--flux", choices=["both", "yes", "no"], default="both")
    options.add_argument("--stop", type=float, default=60.0, help="CPU seconds of one log")
    options.add_argument("--seed", type=int, default=1)
    given = options.parse_args()
    rule = Settings().identification
    print("| log | frames | CPU ms per frame | with stars | right | wrong | search_limit |")
    print("|---|---|---|---|---|---|---|")
    for kind in given.kinds:
        for field in given.fields:
            for flux in {"both": (True, False), "yes": (True,), "no": (False,)}[given.flux]:
                for n in given.frames:
                    name = f"{kind}, {field:g} degrees, {'flux' if flux else 'no flux'}"
                    log = make_log(kind, field, n, flux, given.seed)
                    print(row(name, log, rule, given.stop), flush=True)


if __name__ == "__main__":
    main()

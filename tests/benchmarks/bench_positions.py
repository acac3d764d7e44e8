"""Positions: errors against the Cramer-Rao bound and against the stated covariance.

``python tests/benchmarks/bench_positions.py [--positions N] [--runs DIR]``

Views have the errors that the pipeline assumes: centroid errors are independent, attitude and
position errors of a sensor are shared by its views. The published rule (mean of the pairwise
intersections) gets the same views. With ``--runs`` it averages the reports of ``epipole
evaluate --json`` in a folder.
"""

import argparse
import json
from pathlib import Path

import numpy as np
from scipy.stats import chi2

from epipole.tasks.algorithms.association.epipolar_lines import intersect_sights
from epipole.tasks.algorithms.constants import ARCSEC, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.geometry.triangulation import triangulate

GEO = np.array([-39359.89, 15125.76, 64.30])
V_GEO = np.array([-1.103, -2.870, 0.0])
NOISE, BIAS = 2.25 * ARCSEC, 1.0 * ARCSEC
PLACE_KM = 0.05


def sensors(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return positions of low sensors on the object's side of the Earth."""
    out: list[np.ndarray] = []
    while len(out) < n:
        r = rng.normal(size=3)
        r *= rng.uniform(6980, 7580) / np.linalg.norm(r)
        if r @ GEO > 0.3 * np.linalg.norm(r) * np.linalg.norm(GEO):
            out.append(r)
    return np.array(out)


def bound(r: np.ndarray, x: np.ndarray, variance: float) -> np.ndarray:
    """Return the Cramer-Rao bound, 3x3 [km^2]: the inverse of the information at the truth."""
    information = np.zeros((3, 3))
    for place in r:
        sight = x - place
        rho = np.linalg.norm(sight)
        across = np.eye(3) - np.outer(sight, sight) / rho**2
        information += across / (variance * rho**2 + PLACE_KM**2)
    return np.linalg.inv(information)


def trial(rng: np.random.Generator, n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return reported sensor positions, directions, and the object's true position."""
    r = sensors(rng, n)
    x = GEO + rng.normal(size=3) * 300.0
    rho = np.linalg.norm(x - r, axis=1)
    # Each sensor sees the object where it was at the emission; x is the mean of these.
    emitted = x + V_GEO * (rho.mean() - rho)[:, None] / SPEED_OF_LIGHT_KM_S
    u = (emitted - r) / np.linalg.norm(emitted - r, axis=1, keepdims=True)
    shake = rng.normal(size=(n, 2)) * np.hypot(NOISE, BIAS)
    u += np.einsum("na,nai->ni", shake, tangent_basis(u))
    believed = r + rng.normal(size=(n, 3)) * PLACE_KM
    return believed, u / np.linalg.norm(u, axis=1, keepdims=True), x


def synthetic(n_positions: int) -> None:
    """Print honesty and efficiency for several numbers of sensors."""
    print(f"{n_positions} positions each; centroid 2.25 arcsec, attitude 1, place 0.05 km")
    print("sensors | squared error / covariance / 3 | in 99 % | rms km | bound km | ratio |"
          " published rule, rms km | rejected %")  # fmt: skip
    variance = NOISE**2 + BIAS**2
    for n in (2, 4, 8, 20):
        rng = np.random.default_rng(n)
        trials = [trial(rng, n) for _ in range(n_positions)]
        r = np.concatenate([t[0] for t in trials])
        u = np.concatenate([t[1] for t in trials])
        truth = np.array([t[2] for t in trials])
        offsets = np.arange(n_positions + 1) * n
        cov = np.tile(np.eye(2) * variance, (len(r), 1, 1))
        x, P, _, used, *_ = triangulate(
            offsets, r, u, cov, np.full(len(r), PLACE_KM), np.tile(V_GEO, (n_positions, 1)), 4.0
        )
        off = x - truth
        square = np.einsum("ni,nij,nj->n", off, np.linalg.inv(P), off)
        limit = np.array([bound(t[0], t[2], variance) for t in trials])
        # Two sensors nearly in line with the object do not determine the range. Scaled by the
        # bound, such a trial has the same weight as any other.
        scale = np.trace(limit, axis1=1, axis2=2)
        rms = np.sqrt(np.mean(np.sum(off**2, axis=1) / scale))
        plain = np.array([intersect_sights(t[0], t[1])[0] for t in trials]) - truth
        lines = np.sqrt(np.mean(np.sum(plain**2, axis=1) / scale))
        middle = np.sqrt(np.median(scale))
        print(
            f"{n} | {square.mean() / 3:.3f} | {np.mean(square < chi2.ppf(0.99, 3)):.4f} | "
            f"{rms * middle:.3f} | {middle:.3f} | {rms:.3f} | {lines * middle:.3f} | "
            f"{100 * (1 - used.mean()):.3f}"
        )


def reports(folder: Path) -> None:
    """Print mean, least and largest of every number in the reports of a folder."""
    values: dict[str, list[float]] = {}
    files = sorted(folder.glob("ev*.json"))
    for file in files:
        for name, value in _numbers(json.loads(file.read_text())):
            values.setdefault(name, []).append(value)
    print(f"\nmean, least, most of {len(files)} runs")
    for name, own in values.items():
        print(f"{name}: {np.mean(own):.4f} ({min(own):.4f} .. {max(own):.4f})")


def _numbers(report: dict, prefix: str = "") -> list[tuple[str, float]]:
    out: list[tuple[str, float]] = []
    for name, value in report.items():
        if isinstance(value, dict):
            out += _numbers(value, f"{prefix}{name}.")
        elif isinstance(value, int | float):
            out.append((prefix + name, float(value)))
    return out


def main() -> None:
    """Run the requested parts."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--positions", type=int, default=5000, help="for each number of sensors")
    parser.add_argument("--runs", type=Path, help="folder with ev*.json reports")
    args = parser.parse_args()
    synthetic(args.positions)
    if args.runs:
        reports(args.runs)


if __name__ == "__main__":
    main()

"""Element sets of made-up satellites, of many kinds of orbits: a catalogue to test with."""

import math

import numpy as np

from epipole.schemas.star_lists import ElementSet

NIGHT_NS = 1_780_099_200_000_000_000  # 30 May 2026, 0h
SGP4_DAYS = 27909.0  # the same, in days since 1949 December 31
DAY_NS = 86_400_000_000_000


def satellites(count: int, rng: np.random.Generator, high: float = 0.3) -> list[ElementSet]:
    """Return low satellites and a share of geostationary ones, with epochs of the night before."""
    made = []
    for number in range(count):
        is_high = rng.random() < high
        turns = 1.00273 + rng.normal(0, 1e-4) if is_high else rng.uniform(12.5, 15.2)
        inclination = abs(rng.normal(0, 0.02)) if is_high else rng.uniform(0.5, 1.75)
        days = float(rng.uniform(-1, 0))
        angles = rng.uniform(0, 2 * math.pi, 3)
        elements = (
            SGP4_DAYS + days, 0.0 if is_high else 10 ** rng.uniform(-5, -3.5), 0.0, 0.0,
            rng.uniform(1e-4, 3e-3), angles[0], inclination, angles[1], turns * 2 * math.pi / 1440,
            angles[2],
        )  # fmt: skip
        made.append(
            ElementSet(
                f"SAT {number}", 100_000 + number, NIGHT_NS + round(days * DAY_NS),
                tuple(float(value) for value in elements), f"2020-{number:03d}A",
            )
        )  # fmt: skip
    return made

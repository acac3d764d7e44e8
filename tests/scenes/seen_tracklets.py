"""Tracklets of satellites by sensors that pass near them, made without the code under test."""

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from epipole.schemas.columns import ATTRIBUTABLE_AXES, POSITION, VELOCITY, upper_triangle
from epipole.schemas.star_lists import ElementSet
from epipole.schemas.tables import TRACKLETS
from epipole.tasks.algorithms.known_objects.prediction import predict, satellites_of
from epipole.tasks.algorithms.known_objects.tracklet_search import SeenTracklets
from scenes.associations import filled
from scenes.walker import NIGHT_NS

ARCSEC = np.pi / 648_000
LIGHT_KM_S = 299_792.458
GM_KM3_S2 = 398_600.4418
SIGMAS = np.array([1.0, 1.0, 0.05, 0.05]) * ARCSEC  # of directions [rad] and rates [rad/s]
TO_SUN = np.array([0.365, 0.854, 0.371])  # on 30 May 2026, within a degree


def seen_from_near(
    sets: Sequence[ElementSet], count: int, rng: np.random.Generator, hours: float = 24.0
) -> tuple[SeenTracklets, np.ndarray]:
    """Return tracklets of satellites on the sunny side, and which satellite each shows."""
    satellites = satellites_of(np.array([each.elements for each in sets]))
    rows, times, sensors = [], [], []
    while len(rows) < count:
        row, time_ns = int(rng.integers(len(sets))), NIGHT_NS + int(rng.uniform(0, hours) * 3.6e12)
        state = predict([satellites[row]], np.array([time_ns]))[0, 0]
        sensor = _sensor_near(state, rng)
        if sensor is not None and state[:3] @ TO_SUN > 1000.0:
            rows.append(row)
            times.append(time_ns)
            sensors.append(sensor)
    made = [
        _attributable(satellites[row], time_ns, sensor)
        for row, time_ns, sensor in zip(rows, times, sensors, strict=True)
    ]
    values = np.array(made) + rng.normal(size=(count, 4)) * SIGMAS
    values[:, 0] += (1 / np.cos(values[:, 1]) - 1) * (values[:, 0] - np.array(made)[:, 0])
    states = np.array(sensors)
    return SeenTracklets(
        np.array(times), values[:, :2], values[:, 2:], np.tile(np.diag(SIGMAS**2), (count, 1, 1)),
        states[:, :3], states[:, 3:], np.zeros(count), np.full(count, 6.0),
    ), np.array(rows)  # fmt: skip


def _sensor_near(state: np.ndarray, rng: np.random.Generator) -> np.ndarray | None:
    """Return a sensor in a circular low orbit from which the satellite is seen; None: try again."""
    away = rng.normal(size=3)
    r = state[:3] + away / np.linalg.norm(away) * rng.uniform(300.0, 2500.0)
    if np.linalg.norm(state[:3]) > 10_000:  # a high satellite, from low orbit
        r = -away / np.linalg.norm(away) * 7000.0
        if r @ state[:3] < 0:
            return None
    size = np.linalg.norm(r)
    if size < 6700:
        return None
    across = np.cross(r, rng.normal(size=3))
    return np.concatenate([r, across / np.linalg.norm(across) * np.sqrt(GM_KM3_S2 / size)])


def _attributable(satellite, time_ns: int, sensor: np.ndarray) -> list[float]:
    """Return ra, dec [rad] and their rates [rad/s] (the first times cos dec)."""
    step_s = 0.02
    places = []
    for dt_s in (-step_s, 0.0, step_s):
        from_km = sensor[:3] + dt_s * sensor[3:]
        sent_s = dt_s
        for _ in range(4):  # light time
            at = np.array([time_ns + round(sent_s * 1e9)])
            line = predict([satellite], at)[0, 0, :3] - from_km
            sent_s = dt_s - np.linalg.norm(line) / LIGHT_KM_S
        places.append(line / np.linalg.norm(line))
    moves = (places[2] - places[0]) / (2 * step_s)
    ra, dec = np.arctan2(places[1][1], places[1][0]), np.arcsin(places[1][2])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    return [ra, dec, moves @ east, moves @ np.cross(places[1], east)]


def as_table(seen: SeenTracklets, ids: Sequence[str], **columns: list) -> pa.Table:
    """Return TRACKLETS of one sensor each; `columns` replace those that are made."""
    count = len(ids)
    cov = seen.cov / ARCSEC**2
    rows = {
        "tracklet_id": ids, "track_id": list(ids), "sensor_id": ["sat0"] * count,
        "start_time": seen.time_ns - 10**9, "end_time": seen.time_ns + 10**9,
        "epoch": seen.time_ns, "ra_deg": np.degrees(seen.ra_dec[:, 0]),
        "dec_deg": np.degrees(seen.ra_dec[:, 1]), "ra_rate_arcsec_s": seen.rates[:, 0] / ARCSEC,
        "dec_rate_arcsec_s": seen.rates[:, 1] / ARCSEC,
        **dict(zip(POSITION, seen.r_km.T, strict=True)),
        **dict(zip(VELOCITY, seen.v_km_s.T, strict=True)),
        **{f"cov_{a}{b}": cov[:, i, j] for (a, b), i, j in zip(
            upper_triangle(ATTRIBUTABLE_AXES), *np.triu_indices(4), strict=True)},
    }  # fmt: skip
    return filled(TRACKLETS, count, rows | columns)

"""About ten tracklets of a few sensors, and the formulas of association written once more.

The formulas are plain NumPy on `Samples`: directions, no planes, no grids, no lists of sensors.
They are slow, short, and share no code with the search.
"""

import itertools
from typing import NamedTuple

import numpy as np
from scipy.stats import norm

from epipole.tasks.algorithms.association.arcs import arc_odds
from epipole.tasks.algorithms.association.chance import Chance
from epipole.tasks.algorithms.association.odds import (
    FLASH_SHARE,
    MAG_PER_RAD,
    OTHER_MAG,
    SAME_MAG,
)
from epipole.tasks.algorithms.association.samples import InstantPoints, Samples
from epipole.tasks.algorithms.association.search.field_index import cones_of, field_index
from epipole.tasks.algorithms.association.search.search_space import (
    SearchSpace,
    WorkSpace,
    work_space,
)
from epipole.tasks.algorithms.association.views import views_of
from epipole.tasks.algorithms.constants import (
    ARCSEC,
    EARTH_RADIUS_KM,
    GM_KM3_S2,
    SPEED_OF_LIGHT_KM_S,
)
from epipole.tasks.algorithms.geometry.directions import tangent_basis

FARTHEST_KM = 1e5
LOWEST_KM = EARTH_RADIUS_KM + 100.0
GATE_SIGMA = 4.5
HALF_FIELD = np.tan(np.radians(3.0))


class TenTracklets(NamedTuple):
    """Tracklets in the order of the search: `who` (t,) is the object of each, -1 for none."""

    samples: Samples
    who: np.ndarray
    space: SearchSpace
    work: WorkSpace


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def ten_tracklets(
    seed,
    *,
    n_sensors=4,
    times=(0.0,),
    n_objects=2,
    n_strays=3,
    spread_km=150.0,
    moving=False,
    seen=1.0,
    sigma_km=0.05,
    shells=(),
    magnitudes=False,
    blend_rad=0.0,
):
    """Return a random scene: objects that all sensors see, and tracklets that one sensor sees.

    `moving`: directions have rates, and light takes its time. `seen`: share of the instants at
    which a tracklet is seen. `magnitudes`: most tracklets have one. `blend_rad`: see `Samples`.
    The errors of the directions differ along two axes.
    """
    rng = np.random.default_rng(seed)
    times = np.asarray(times, float)
    middle = unit(rng.normal(size=3)) * rng.uniform(9000.0, 42000.0)
    r, v = _sensors(rng, n_sensors, middle, times)
    paths = [_orbit(middle, rng, spread_km) for _ in range(n_objects)]
    sensor, who, lines = [], [], []
    for s in range(n_sensors):
        for k, path in enumerate(paths):
            sensor, who, lines = [*sensor, s], [*who, k], [*lines, path]
        for _ in range(n_strays):
            sensor, who = [*sensor, s], [*who, -1]
            lines.append(_orbit(middle, rng, spread_km))
    sensor = np.array(sensor)
    u = np.stack(
        [_seen_from(p, r[s], v[s], times, moving) for s, p in zip(sensor, lines, strict=True)]
    )
    rate = np.zeros_like(u)
    if moving:
        for n, (s, path) in enumerate(zip(sensor, lines, strict=True)):
            ahead = _seen_from(path, r[s] + 0.1 * v[s], v[s], times + 0.1, True)
            rate[n] = (ahead - u[n]) / 0.1
    cov = _errors(rng, u.shape[:2])
    off = np.einsum("tkab,tkb->tka", np.linalg.cholesky(cov), rng.normal(size=(*u.shape[:2], 2)))
    u = unit(u + np.einsum("tka,tkai->tki", off, tangent_basis(u)))
    there = rng.random(u.shape[:2]) < seen
    there[np.arange(len(u)), rng.integers(len(times), size=len(u))] = True
    look = unit(middle + 0.002 * rng.normal(size=(n_sensors, 1, 3)) * 42000.0 - r)
    samples = Samples(
        sensor=sensor,
        start_s=np.array([times[t].min() for t in there]),
        end_s=np.array([times[t].max() for t in there]),
        seen=there,
        u=u,
        cov=cov,
        sigma_km=rng.uniform(0.5, 1.5, u.shape[:2]) * sigma_km,
        time_s=times,
        sensor_km=r,
        R_sensor_from_icrs=np.concatenate([tangent_basis(look), look[:, :, None]], axis=2),
        half_field=np.full((n_sensors, 2), HALF_FIELD) * rng.uniform(0.5, 1.0, (n_sensors, 2)),
        rate=rate if moving else None,
        sensor_km_s=v if moving else None,
        magnitude=_magnitudes(rng, who) if magnitudes else None,
        blend_rad=np.full(n_sensors, blend_rad),
    )
    return scene_of(samples, np.array(who), rng, shells)


def scene_of(samples, who, rng, shells=()):
    """Return the scene with its tracklets in the order of the search, and random chances."""
    _, order = views_of(samples)
    n = len(order)
    samples = samples._replace(
        **{
            name: getattr(samples, name)[order]
            for name in ("sensor", "start_s", "end_s", "seen", "u", "cov", "sigma_km")
        },
        rate=None if samples.rate is None else samples.rate[order],
        magnitude=None if samples.magnitude is None else samples.magnitude[order],
    )
    views, again = views_of(samples)
    assert (again == np.arange(n)).all()
    n_sensors, cones = len(samples.half_field), cones_of(views)
    chance = Chance(
        density=rng.uniform(0.5, 5.0, n_sensors) * 1e3,
        drift=np.zeros((n_sensors, 3)),
        spread=rng.uniform(1.0, 30.0, n_sensors) * ARCSEC,
        objects_in_view=5.0,
        objects_km3=1e-11,
        detected=rng.uniform(0.6, 0.97, n_sensors),
    )
    space = SearchSpace(
        views=views,
        chance=chance,
        taken=np.zeros(n, np.bool_),
        shells=np.array(shells, float).reshape(-1, 3),
        lowest_km=LOWEST_KM,
        farthest_km=FARTHEST_KM,
        gate_sigma=GATE_SIGMA,
        fields=field_index(cones, FARTHEST_KM),
    )
    return TenTracklets(samples, np.asarray(who)[order], space, work_space(views))


def _sensors(rng, n, middle, times):
    """Return positions (n, k, 3) and velocities of low sensors, the Earth not in the way."""
    out = []
    while len(out) < n:
        up = unit(rng.normal(size=3))
        if up @ unit(middle) > 0.5:
            out.append(up)
    out = np.array(out) * rng.uniform(6900.0, 7600.0, (n, 1))
    v = unit(np.cross(out, rng.normal(size=(n, 3)))) * 7.5
    return out[:, None] + v[:, None] * times[:, None], np.repeat(v[:, None], len(times), axis=1)


def _orbit(middle, rng, spread_km):
    """Return an object's position as a function of time [s]: a short part of an orbit."""
    x = middle + rng.normal(size=3) * spread_km
    speed = np.sqrt(GM_KM3_S2 / np.linalg.norm(x))
    v = unit(np.cross(x, [0.3, -0.5, 0.8])) * speed * rng.uniform(0.99, 1.01)
    pull = -GM_KM3_S2 * x / np.linalg.norm(x) ** 3
    return lambda t: x + v * np.asarray(t)[:, None] + 0.5 * pull * np.asarray(t)[:, None] ** 2


def _seen_from(path, r, v, times, moving):
    """Return directions (k, 3): where the light left the object, or where it is by geometry."""
    delay = np.zeros(len(times))
    for _ in range(4 if moving else 1):
        away = path(times - delay) - r
        delay = np.linalg.norm(away, axis=1) / SPEED_OF_LIGHT_KM_S
    return unit(away)


def _magnitudes(rng, who):
    """Return magnitudes (t,): objects differ, the sensors that see one little; some are unknown."""
    who = np.array(who)
    usual = np.append(rng.normal(9.0, 1.0, who.max() + 1), 9.0)[who]
    out = usual + rng.normal(0.0, np.where(who < 0, 1.0, 0.3))
    return np.where(rng.random(len(who)) < 0.2, np.nan, out)


def _errors(rng, shape):
    """Return covariances (..., 2, 2) [rad^2] of unequal axes, of 0.5 to 4 arcsec."""
    turn = rng.uniform(0, np.pi, shape)
    R = np.stack([np.cos(turn), -np.sin(turn), np.sin(turn), np.cos(turn)], axis=-1)
    R = R.reshape(*shape, 2, 2)
    size = rng.uniform(0.5, 4.0, (*shape, 2)) * ARCSEC
    return np.einsum("...ab,...b,...cb->...ac", R, size**2, R)


# The formulas.


def quantile(dof, sigma):
    """Wilson and Hilferty's chi-square."""
    return dof * (1 - 2 / (9 * dof) + sigma * (2 / (9 * dof)) ** 0.5) ** 3


def residual(samples, i, m, x):
    """Return predicted minus measured (2,) and its covariance; None behind the sensor."""
    s, u = samples.sensor[i], samples.u[i, m]
    r = samples.sensor_km[s, m]
    rho = np.linalg.norm(x - r)
    measured = u
    if samples.rate is not None and samples.rate[i, m].any():
        later = (rho - np.linalg.norm(x)) / SPEED_OF_LIGHT_KM_S
        measured = u + samples.rate[i, m] * later
        r = r + samples.sensor_km_s[s, m] * later
    predicted = unit(x - r)
    if predicted @ u <= 0:
        return None
    error = tangent_basis(u) @ (predicted - measured)
    return error, samples.cov[i, m] + (samples.sigma_km[i, m] / rho) ** 2 * np.eye(2)


def partials(samples, i, m, x):
    """Return the derivatives (2, 3) of a view's residual [1/km]."""
    d = x - samples.sensor_km[samples.sensor[i], m]
    rho = np.linalg.norm(d)
    across = np.eye(3) - np.outer(d, d) / rho**2
    return tangent_basis(samples.u[i, m]) @ across / rho


def point(samples, members, m):
    """Return the point (3,) of the members' views at an instant, its covariance, chi-square."""
    there = [i for i in members if samples.seen[i, m]]
    N, b = np.zeros((3, 3)), np.zeros(3)
    for i in there:
        across = np.eye(3) - np.outer(samples.u[i, m], samples.u[i, m])
        N += across
        b += across @ samples.sensor_km[samples.sensor[i], m]
    x = np.linalg.solve(N, b)
    for _ in range(10):
        N, b, chi2 = np.zeros((3, 3)), np.zeros(3), 0.0
        for i in there:
            if (found := residual(samples, i, m, x)) is None:
                return None
            J, W = partials(samples, i, m, x), np.linalg.inv(found[1])
            N, b, chi2 = N + J.T @ W @ J, b + J.T @ W @ found[0], chi2 + found[0] @ W @ found[0]
        step = np.linalg.solve(N, b)
        x = x - step
        if step @ N @ step < 1e-10:
            break
    return x, np.linalg.inv(N), chi2


def points_of(samples, members):
    """Return the points (x, covariance) by instant, chi-square and degrees of freedom.

    None where an instant has no point.
    """
    found, total, dof = {}, 0.0, 0
    for m in range(len(samples.time_s)):
        count = sum(samples.seen[i, m] for i in members)
        if count < 2:
            continue
        if (solved := point(samples, members, m)) is None:
            return None
        found[m] = solved[:2]
        total, dof = total + solved[2], dof + 2 * count - 3
    return found, total, dof


def enter(work, samples, members, points):
    """Enter points in the work arrays of the search."""
    work.points.seen_by[:] = samples.seen[list(members)].sum(axis=0)
    for m, (x, P) in points.items():
        work.points.x_km[m], work.points.cov_km2[m] = x, P


def clash(samples, i, j):
    """Return whether two tracklets cannot be one object: the same sensor, at the same time."""
    return samples.sensor[i] == samples.sensor[j] and not (
        samples.end_s[i] < samples.start_s[j] or samples.end_s[j] < samples.start_s[i]
    )


def blocked(r, x, radius=EARTH_RADIUS_KM):
    """Return whether the line from r to x passes through the Earth on its way."""
    part = -(r @ (x - r)) / ((x - r) @ (x - r))
    return 0 < part < 1 and np.linalg.norm(r + part * (x - r)) < radius


def in_field(samples, s, m, x):
    """Return whether a sensor has x well in its field, the Earth not in the way."""
    R, r = samples.R_sensor_from_icrs[s, m], samples.sensor_km[s, m]
    if not np.isfinite(R).all() or not np.isfinite(r).all():
        return False
    a, b, depth = R @ (x - r)
    if depth <= 0:
        return False
    inside = np.abs([a / depth, b / depth]) <= 0.98 * samples.half_field[s]
    return bool(inside.all()) and not blocked(r, x)


def range_km(samples, s, m, x):
    return np.linalg.norm(x - samples.sensor_km[s, m])


def expected_sensors(samples, members, points):
    """Return the sensors that should detect the object: in their field, bright enough, and apart
    from other objects.

    A sensor without any tracklet at the points' instants is not counted (`odds.near_fields`).
    """
    first = min(points)
    x = points[first][0]
    nearest = min(
        range_km(samples, samples.sensor[i], first, x) for i in members if samples.seen[i, first]
    )
    return [
        s
        for s in range(len(samples.half_field))
        if all(in_field(samples, s, m, at) for m, (at, _) in points.items())
        and range_km(samples, s, first, x) <= 1.5 * nearest
        and any(samples.seen[samples.sensor == s][:, list(points)].any(axis=0))
        and not blends(samples, s, first, x)
    ]


def blends(samples, s, m, x):
    """Return whether a sensor sees another object so near the line to x that both are one dot."""
    if samples.blend_rad is None:
        return False
    u = unit(x - samples.sensor_km[s, m])
    there = np.flatnonzero((samples.sensor == s) & samples.seen[:, m])
    return bool((np.arccos(samples.u[there, m] @ u) < samples.blend_rad[s]).any())


def altitude_weight(shells, x):
    """Return ln of the density of objects at x over the mean."""
    if not len(shells):
        return 0.0
    radius = np.linalg.norm(x)
    return np.log(1e-9 + sum(w for lo, hi, w in shells if lo <= radius < hi))


def possible(samples, members, points):
    """Return whether the points are where their sensors can see an object, within 3 sigma."""
    for m, (x, P) in points.items():
        slack, radius = 3 * np.sqrt(np.trace(P)), np.linalg.norm(x)
        if radius + slack < LOWEST_KM or radius - min(slack, 0.2 * FARTHEST_KM) > FARTHEST_KM:
            return False
        for i in members:
            r = samples.sensor_km[samples.sensor[i], m]
            if samples.seen[i, m] and blocked(r, x, EARTH_RADIUS_KM - slack):
                return False
    return True


def magnitude_odds(samples, members, points):
    """Return the log-odds by magnitudes: each sensor's, given that seen from the nearest side."""
    total, before = 0.0, {}
    for i in members:
        there = [m for m in sorted(points) if samples.seen[i, m]]
        s = int(samples.sensor[i])
        if samples.magnitude is None or np.isnan(samples.magnitude[i]) or not there or s in before:
            continue
        line = points[there[0]][0] - samples.sensor_km[s, there[0]]
        reduced = samples.magnitude[i] - 5 * np.log10(np.linalg.norm(line))
        if before:
            other, nearest = max(before.values(), key=lambda seen: seen[1] @ unit(line))
            angle = np.arccos(np.clip(nearest @ unit(line), -1, 1))
            sigma = min(np.hypot(SAME_MAG, MAG_PER_RAD * angle), OTHER_MAG)
            same, unrelated = (norm.pdf(reduced - other, 0, size) for size in (sigma, OTHER_MAG))
            total += np.log((FLASH_SHARE * unrelated + (1 - FLASH_SHARE) * same) / unrelated)
        before[s] = reduced, unit(line)
    return total


def score(scene, members):
    """Return the log-odds of a set of tracklets as one object, and the sensors that miss it.

    -inf where they do not fit. At several instants the orbit's part is that of `arcs`.
    """
    samples, space = scene.samples, scene.space
    if (solved := points_of(samples, members)) is None or not solved[0]:
        return -np.inf, []
    points, chi2, dof = solved
    if chi2 > quantile(max(dof, 1), space.gate_sigma) or not possible(samples, members, points):
        return -np.inf, []
    m = min(points)
    x, P = points[m]
    if len(points) == 1:
        total = 1.5 * np.log(2 * np.pi) + 0.5 * np.linalg.slogdet(P)[1]
        for i in members:
            if samples.seen[i, m]:
                error, cov = residual(samples, i, m, x)
                spot = 2 * np.pi * np.sqrt(np.linalg.det(cov))
                total -= np.log(space.chance.density[samples.sensor[i]] * spot)
                total -= 0.5 * error @ np.linalg.solve(cov, error)
    else:
        k = len(samples.time_s)
        arrays = InstantPoints(
            np.zeros((k, 3)), np.zeros((k, 3, 3)), np.zeros((k, 3, 3)), np.zeros(k, np.int64)
        )
        enter(scene.work._replace(points=arrays), samples, members, points)
        total = arc_odds(space.views, space.chance, np.array(members), arrays)[0]
    total += np.log(space.chance.objects_km3) + altitude_weight(space.shells, x)
    total += magnitude_odds(samples, members, points)
    has = {int(samples.sensor[i]) for i in members}
    missed = [s for s in expected_sensors(samples, members, points) if s not in has]
    detected = space.chance.detected
    total += sum(np.log(detected[s]) for s in has) + sum(np.log(1 - detected[s]) for s in missed)
    return total, missed


def gain_of(scene, c, points, gate_sigma=GATE_SIGMA):
    """Return what tracklet c adds to the log-odds of points; -inf where it does not fit."""
    samples, chance, s = scene.samples, scene.space.chance, scene.samples.sensor[c]
    gain, total, n, begun = 0.0, 0.0, 0, 0.0
    for m, (x, P) in sorted(points.items()):
        if not samples.seen[c, m]:
            continue
        if (found := residual(samples, c, m, x)) is None:
            return -np.inf
        J = partials(samples, c, m, x)
        cov = found[1] + J @ P @ J.T
        chi2 = found[0] @ np.linalg.solve(cov, found[0])
        spot = 2 * np.pi * np.sqrt(np.linalg.det(cov))
        if n == 0:
            begun = samples.time_s[m]
            gain += np.log(chance.detected[s] / (chance.density[s] * spot)) - chi2 / 2
        else:
            room = np.pi * (chance.spread[s] * (samples.time_s[m] - begun)) ** 2
            gain += np.log(1 + room / spot) - chi2 / 2
        total, n = total + chi2, n + 1
    return gain if n and total <= quantile(2 * n, gate_sigma) else -np.inf


def subsets(samples, among):
    """Return all sets of two or more of the tracklets that may be one object.

    Sets are left out that hold two views of one sensor at a time, or two views so far apart that
    their chi-square alone is beyond any gate: that of the set is larger.
    """
    apart = {
        (i, j)
        for i, j in itertools.combinations(among, 2)
        if clash(samples, i, j) or (solved := points_of(samples, (i, j))) is None or solved[1] > 500
    }
    for n in range(2, len(among) + 1):
        for members in itertools.combinations(among, n):
            if apart.isdisjoint(itertools.combinations(members, 2)):
                yield members

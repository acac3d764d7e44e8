"""Association: which tracklets of different sensors are one object.

Over a short span every tracklet is sampled at a few common instants. Two tracklets of two
sensors whose lines of sight meet, within their errors, above the Earth, begin a hypothesis;
other sensors' tracklets that its points explain join it; the hypotheses are weighed by their
likelihood against "all of these are different things", and taken best first. What two
hypotheses explain equally well is not decided but called ambiguous.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import njit

from epipole.tasks.algorithms.sky import tangent_basis
from epipole.tasks.algorithms.triangulation import solve_point, start_point

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

EARTH_RADIUS_KM = 6378.137
DETECTED = 0.9  # probability that a sensor which looks at an object has a tracklet of it
FREE = -1


class Samples(NamedTuple):
    """Tracklets of all sensors at a few common instants: t tracklets, k instants.

    sensor : (t,) int
        Whose tracklet it is, 0 .. s - 1.
    start_s, end_s : (t,) float
        First and last detection [s]; tracklets of one sensor that overlap are two objects.
    seen : (t, k) bool
        The tracklet has a direction at the instant.
    r_km : (t, k, 3) float
        Sensor positions, GCRF [km].
    u : (t, k, 3) float
        Directions without aberration, ICRS.
    cov : (t, k, 2, 2) float
        Their covariances [rad^2] on `tangent_basis(u)`.
    sigma_km : (t, k) float
        1-sigma errors of the sensor positions an axis.
    time_s : (k,) float
        The instants.
    field_sr : (s,) float
        Solid angle of each sensor's field.
    boresight : (s, k, 3) float
        Where the sensors look, ICRS; NaN where unknown.
    sensor_km : (s, k, 3) float
        Where the sensors are; NaN where unknown.
    inner_rad : (s,) float
        Radius of the largest circle that the field holds.
    """

    sensor: Indices
    start_s: Array
    end_s: Array
    seen: npt.NDArray[np.bool_]
    r_km: Array
    u: Array
    cov: Array
    sigma_km: Array
    time_s: Array
    field_sr: Array
    boresight: Array
    sensor_km: Array
    inner_rad: Array


class Groups(NamedTuple):
    """What `associate_tracklets` found.

    group : (t,) int
        Group of each tracklet; -1 where it belongs to none.
    score : (g,) float
        Log of the odds of each group against its members being unrelated.
    ambiguous : (t,) bool
        Tracklets left out because two groups claim them about equally well, or because one
        does without being sure enough.
    """

    group: Indices
    score: Array
    ambiguous: npt.NDArray[np.bool_]


@njit(cache=True, nogil=True)
def _quantile(dof, sigma):
    """Return the chi-square with `dof` degrees of freedom that is as rare as `sigma`.

    Wilson and Hilferty (1931): the cube root is close to normal.
    """
    a = 2.0 / (9.0 * dof)
    return dof * (1.0 - a + sigma * np.sqrt(a)) ** 3


@njit(cache=True, nogil=True)
def _blocked(r, x, radius):
    """Return whether the Earth stands between r and x."""
    dot, length2, r2 = 0.0, 0.0, 0.0
    for a in range(3):
        d = x[a] - r[a]
        dot += r[a] * d
        length2 += d * d
        r2 += r[a] * r[a]
    t = -dot / length2
    return 0.0 < t < 1.0 and r2 - dot * dot / length2 < radius * radius


@njit(cache=True, nogil=True)
def _pair_chi2(r_1, u_1, cov_1, sigma_1, basis_1, r_2, u_2, cov_2, sigma_2, basis_2):
    """Return the squared miss of two lines over its variance; NaN where they meet behind."""
    n = np.empty(3)
    n[0] = u_1[1] * u_2[2] - u_1[2] * u_2[1]
    n[1] = u_1[2] * u_2[0] - u_1[0] * u_2[2]
    n[2] = u_1[0] * u_2[1] - u_1[1] * u_2[0]
    sine2 = n[0] ** 2 + n[1] ** 2 + n[2] ** 2
    if sine2 < 1e-14:  # 0.02 arcsec: parallel for any sensor
        return np.nan
    miss, b1, b2, cosine = 0.0, 0.0, 0.0, 0.0
    for a in range(3):
        b = r_2[a] - r_1[a]
        miss += b * n[a]
        b1 += b * u_1[a]
        b2 += b * u_2[a]
        cosine += u_1[a] * u_2[a]
    range_1 = (b1 - cosine * b2) / sine2
    range_2 = (cosine * b1 - b2) / sine2
    if range_1 <= 0.0 or range_2 <= 0.0:
        return np.nan
    variance = sigma_1**2 + sigma_2**2
    sine = np.sqrt(sine2)
    for a in range(2):
        for b in range(2):
            p1 = (basis_1[a, 0] * n[0] + basis_1[a, 1] * n[1] + basis_1[a, 2] * n[2]) / sine
            q1 = (basis_1[b, 0] * n[0] + basis_1[b, 1] * n[1] + basis_1[b, 2] * n[2]) / sine
            p2 = (basis_2[a, 0] * n[0] + basis_2[a, 1] * n[1] + basis_2[a, 2] * n[2]) / sine
            q2 = (basis_2[b, 0] * n[0] + basis_2[b, 1] * n[1] + basis_2[b, 2] * n[2]) / sine
            variance += range_1**2 * p1 * cov_1[a, b] * q1 + range_2**2 * p2 * cov_2[a, b] * q2
    return (miss / sine) ** 2 / variance


@njit(cache=True, nogil=True)
def _seeds(sensor, seen, r, u, basis, cov, sigma_km, gate_sigma):
    """Return the pairs of tracklets of two sensors whose lines of sight meet."""
    t, k = seen.shape
    found = [(0, 0) for _ in range(0)]
    for i in range(t):
        for j in range(i + 1, t):
            if sensor[i] == sensor[j]:
                continue
            total, n = 0.0, 0
            for m in range(k):
                if seen[i, m] and seen[j, m]:
                    total += _pair_chi2(
                        r[i, m],
                        u[i, m],
                        cov[i, m],
                        sigma_km[i, m],
                        basis[i, m],
                        r[j, m],
                        u[j, m],
                        cov[j, m],
                        sigma_km[j, m],
                        basis[j, m],
                    )
                    n += 1
            if n and total <= _quantile(n, gate_sigma):  # false for NaN
                found.append((i, j))
    return found


@njit(cache=True, nogil=True)
def _solve_samples(members, seen, r, u, basis, cov, sigma_km, X, P, n_views):
    """Triangulate the members at every instant; return chi-square and degrees of freedom.

    NaN where an instant with two or more views has no solution.
    """
    still = np.zeros(3)
    total, dof = 0.0, 0
    for m in range(seen.shape[1]):
        count = 0
        for i in members:
            count += seen[i, m]
        n_views[m] = count
        if count < 2:
            continue
        use, n = np.empty(count, np.int64), 0
        for i in members:
            if seen[i, m]:
                use[n] = i
                n += 1
        if not start_point(use, r[:, m], u[:, m], X[m]):
            return np.nan, 0
        chi2 = solve_point(
            use, r[:, m], u[:, m], basis[:, m], cov[:, m], sigma_km[:, m], still, X[m], P[m]
        )
        if np.isnan(chi2):
            return np.nan, 0
        total += chi2
        dof += 2 * count - 3
    return total, dof


@njit(cache=True, nogil=True)
def _possible(members, seen, r, X, P, n_views, lowest, farthest):
    """Return whether the points lie, within 3 sigma, where an object can be seen."""
    for m in range(len(n_views)):
        if n_views[m] < 2:
            continue
        radius = np.sqrt(X[m, 0] ** 2 + X[m, 1] ** 2 + X[m, 2] ** 2)
        slack = 3.0 * np.sqrt(P[m, 0, 0] + P[m, 1, 1] + P[m, 2, 2])
        if radius + slack < lowest or radius - slack > farthest:
            return False
        for i in members:
            if seen[i, m] and _blocked(r[i, m], X[m], EARTH_RADIUS_KM - slack):
                return False
    return True


@njit(cache=True, nogil=True)
def _joins(i, seen, r, u, basis, cov, sigma_km, X, P, n_views, gate_sigma):
    """Return the chi-square of tracklet i with the points, and how many instants it shares."""
    total, n = 0.0, 0
    C = np.empty((2, 2))
    e = np.empty(2)
    for m in range(len(n_views)):
        if n_views[m] < 2 or not seen[i, m]:
            continue
        ahead, rho2 = 0.0, 0.0
        for a in range(3):
            d = X[m, a] - r[i, m, a]
            ahead += d * u[i, m, a]
            rho2 += d * d
        if ahead <= 0.0:
            return np.inf, 0
        rho = np.sqrt(rho2)
        for a in range(2):
            e[a] = 0.0
            for c in range(3):
                e[a] += basis[i, m, a, c] * (X[m, c] - r[i, m, c]) / rho
            for b in range(2):
                C[a, b] = cov[i, m, a, b] + ((sigma_km[i, m] ** 2 / rho2) if a == b else 0.0)
                for c in range(3):
                    for d3 in range(3):
                        C[a, b] += basis[i, m, a, c] * P[m, c, d3] * basis[i, m, b, d3] / rho2
        det = C[0, 0] * C[1, 1] - C[0, 1] ** 2
        total += (e[0] ** 2 * C[1, 1] - 2 * e[0] * e[1] * C[0, 1] + e[1] ** 2 * C[0, 0]) / det
        n += 1
        if total > 4 * _quantile(2 * len(n_views), gate_sigma):
            return np.inf, 0
    return total, n


@njit(cache=True, nogil=True)
def _score(
    members,
    sensor,
    seen,
    cov,
    X,
    P,
    n_views,
    chi2,
    time_s,
    density,
    spread,
    prior_density,
    boresight,
    sensor_km,
    inner_rad,
):
    """Return the log of the odds "one object" against "unrelated tracklets".

    At the first instant a stray tracklet lies anywhere in the field (`density` a steradian)
    and an object anywhere in view (`prior_density` a km^3). At a later one both are known to
    within how differently (`spread`, rad/s) the tracklets of a sensor move: where all move
    alike, further instants say nothing new.
    """
    score, begun, begun_at = -0.5 * chi2, False, 0.0
    n_sensors = boresight.shape[0]
    for m in range(len(n_views)):
        if n_views[m] < 2:
            continue
        dt = time_s[m] - begun_at if begun else 0.0
        widest, rho_mean = 0.0, 0.0
        for i in members:
            if not seen[i, m]:
                continue
            det = cov[i, m, 0, 0] * cov[i, m, 1, 1] - cov[i, m, 0, 1] ** 2
            spot = 2 * np.pi * np.sqrt(det)
            if begun:
                room = spot + np.pi * (spread[sensor[i]] * dt) ** 2
                score += np.log(room / spot)
            else:
                score += np.log(DETECTED / (density[sensor[i]] * spot))
            widest = max(widest, spread[sensor[i]])
            rho = 0.0
            for a in range(3):
                rho += (X[m, a] - sensor_km[sensor[i], m, a]) ** 2
            rho_mean += np.sqrt(rho) / n_views[m]
        det_P = _det3(P[m])
        if begun:
            grown = P[m].copy()
            for a in range(3):
                grown[a, a] += (widest * dt * rho_mean) ** 2
            score += 0.5 * np.log(det_P / _det3(grown))
        else:
            score += 1.5 * np.log(2 * np.pi) + 0.5 * np.log(det_P) + np.log(prior_density)
            score += _absent(members, sensor, X[m], m, boresight, sensor_km, inner_rad, n_sensors)
            begun, begun_at = True, time_s[m]
    return score


@njit(cache=True, nogil=True)
def _det3(M):
    return (
        M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
        - M[0, 1] * (M[1, 0] * M[2, 2] - M[1, 2] * M[2, 0])
        + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
    )


@njit(cache=True, nogil=True)
def _absent(members, sensor, x, m, boresight, sensor_km, inner_rad, n_sensors):
    """Return the log-probability that sensors which look at x have no tracklet of it."""
    total = 0.0
    for s in range(n_sensors):
        taken = False
        for i in members:
            taken = taken or sensor[i] == s
        if taken or np.isnan(boresight[s, m, 0]) or np.isnan(sensor_km[s, m, 0]):
            continue
        dot, rho2 = 0.0, 0.0
        for a in range(3):
            d = x[a] - sensor_km[s, m, a]
            dot += d * boresight[s, m, a]
            rho2 += d * d
        if dot > np.sqrt(rho2) * np.cos(inner_rad[s]) and not _blocked(
            sensor_km[s, m], x, EARTH_RADIUS_KM
        ):
            total += np.log(1.0 - DETECTED)
    return total


@njit(cache=True, nogil=True)
def _grow(
    i,
    j,
    taken,
    sensor,
    start_s,
    end_s,
    seen,
    r,
    u,
    basis,
    cov,
    sigma_km,
    time_s,
    density,
    spread,
    prior_density,
    boresight,
    sensor_km,
    inner_rad,
    lowest,
    farthest,
    gate_sigma,
    members,
):
    """Grow the seed (i, j) by the tracklets that its points explain, the best fit first.

    Returns how many `members` there are and their score; 0 members where the seed fails.
    """
    t, k = seen.shape
    X, P, n_views = np.zeros((k, 3)), np.zeros((k, 3, 3)), np.zeros(k, np.int64)
    members[0], members[1] = i, j
    n = 2
    chi2, dof = _solve_samples(members[:n], seen, r, u, basis, cov, sigma_km, X, P, n_views)
    if not chi2 <= _quantile(max(dof, 1), gate_sigma):
        return 0, -np.inf
    if not _possible(members[:n], seen, r, X, P, n_views, lowest, farthest):
        return 0, -np.inf
    refused = np.zeros(t, np.bool_)
    while True:
        best, best_odds = FREE, np.inf
        for c in range(t):
            if taken[c] or refused[c]:
                continue
            clash = False
            for q in range(n):
                other = members[q]
                clash = (
                    clash
                    or other == c
                    or (
                        sensor[other] == sensor[c]
                        and start_s[c] <= end_s[other]
                        and start_s[other] <= end_s[c]
                    )
                )
            if clash:
                continue
            value, shared = _joins(c, seen, r, u, basis, cov, sigma_km, X, P, n_views, gate_sigma)
            if shared == 0 or value > _quantile(2 * shared, gate_sigma):
                continue
            if value / shared < best_odds:
                best, best_odds = c, value / shared
        if best == FREE:
            break
        members[n] = best
        new_chi2, new_dof = _solve_samples(
            members[: n + 1], seen, r, u, basis, cov, sigma_km, X, P, n_views
        )
        if new_chi2 <= _quantile(max(new_dof, 1), gate_sigma) and _possible(
            members[: n + 1], seen, r, X, P, n_views, lowest, farthest
        ):
            n, chi2, dof = n + 1, new_chi2, new_dof
        else:
            refused[best] = True
            chi2, dof = _solve_samples(members[:n], seen, r, u, basis, cov, sigma_km, X, P, n_views)
    return n, _score(
        members[:n],
        sensor,
        seen,
        cov,
        X,
        P,
        n_views,
        chi2,
        time_s,
        density,
        spread,
        prior_density,
        boresight,
        sensor_km,
        inner_rad,
    )


def associate_tracklets(
    samples: Samples,
    *,
    gate_sigma: float,
    min_altitude_km: float,
    max_range_km: float,
    min_log_odds: float,
    ambiguity_log_odds: float,
) -> Groups:
    """Return which tracklets are one object.

    Parameters
    ----------
    samples
        The tracklets at their common instants.
    gate_sigma
        Views of one object agree within this (as a chi-square just as rare).
    min_altitude_km, max_range_km
        Objects are looked for between this height and this distance from the Earth's centre.
    min_log_odds
        A group is reported if it is more likely than chance by this (natural log).
    ambiguity_log_odds
        Where another group that contradicts it comes closer than this, neither is.

    Notes
    -----
    Deterministic: no random numbers, ties by the order of the tracklets.
    """
    search = _Search(samples, gate_sigma, EARTH_RADIUS_KM + min_altitude_km, max_range_km)
    return search.run(min_log_odds, ambiguity_log_odds)


class _Hypothesis(NamedTuple):
    score: float
    seed: tuple[int, int]
    members: tuple[int, ...]


class _Search:
    """Hypotheses over one set of samples, taken best first."""

    def __init__(
        self, samples: Samples, gate_sigma: float, lowest_km: float, farthest_km: float
    ) -> None:
        self.samples, self.gate_sigma = samples, float(gate_sigma)
        self.limits = (float(lowest_km), float(farthest_km))
        self.basis = np.ascontiguousarray(tangent_basis(samples.u))
        self.taken = np.zeros(len(samples.sensor), np.bool_)
        self.density, self.spread, self.prior_density = _clutter(samples, farthest_km)

    def grow(self, seed: tuple[int, int]) -> _Hypothesis | None:
        s = self.samples
        members = np.empty(len(s.sensor), np.int64)
        n, score = _grow(
            seed[0], seed[1], self.taken, s.sensor, s.start_s, s.end_s, s.seen, s.r_km, s.u,
            self.basis, s.cov, s.sigma_km, s.time_s, self.density, self.spread,
            self.prior_density, s.boresight, s.sensor_km, s.inner_rad, *self.limits,
            self.gate_sigma, members,
        )  # fmt: skip
        return _Hypothesis(score, seed, tuple(sorted(members[:n].tolist()))) if n else None

    def run(self, min_log_odds: float, ambiguity_log_odds: float) -> Groups:
        s = self.samples
        group = np.full(len(s.sensor), FREE)
        ambiguous = np.zeros(len(s.sensor), np.bool_)
        scores: list[float] = []
        seeds = _seeds(
            s.sensor, s.seen, s.r_km, s.u, self.basis, s.cov, s.sigma_km, self.gate_sigma
        )
        open_list = _distinct(filter(None, map(self.grow, seeds)))
        while open_list:
            open_list.sort(key=lambda h: (-h.score, h.members))
            best = open_list.pop(0)
            if best.score < min_log_odds:
                for h in (best, *open_list):  # likelier than not, and not sure enough
                    ambiguous[list(h.members)] |= h.score > 0
                break
            rivals = [
                h
                for h in open_list
                if h.score > best.score - ambiguity_log_odds and _contradict(best, h)
            ]
            kept = set(best.members).intersection(*(h.members for h in rivals))
            if len({s.sensor[i] for i in kept}) < 2:
                kept = set()
            else:
                group[sorted(kept)] = len(scores)
                scores.append(best.score)
            doubtful = sorted(set(best.members) - kept)
            ambiguous[doubtful] = True
            self.taken[list(best.members)] = True
            open_list = self._regrown(open_list)
        return Groups(group, np.array(scores), ambiguous & (group == FREE))

    def _regrown(self, hypotheses: list[_Hypothesis]) -> list[_Hypothesis]:
        """Grow again, without what is taken, the hypotheses that lost a member."""
        out: list[_Hypothesis] = []
        for h in hypotheses:
            if not self.taken[list(h.members)].any():
                out.append(h)
            elif not self.taken[list(h.seed)].any() and (again := self.grow(h.seed)):
                out.append(again)
        return _distinct(out)


def _distinct(hypotheses) -> list[_Hypothesis]:
    """Return one hypothesis for each set of members."""
    best: dict[tuple[int, ...], _Hypothesis] = {}
    for h in hypotheses:
        if h.members not in best or h.score > best[h.members].score:
            best[h.members] = h
    return list(best.values())


def _contradict(a: _Hypothesis, b: _Hypothesis) -> bool:
    """Return whether two hypotheses share a tracklet and neither contains the other."""
    one, other = set(a.members), set(b.members)
    return bool(one & other) and not (one <= other or other <= one)


def _clutter(samples: Samples, farthest_km: float) -> tuple[Array, Array, float]:
    """Return what chance has to work with, estimated from the tracklets themselves.

    Tracklets a steradian and the spread of their rates [rad/s], a sensor each; and objects a
    km^3 of the space in view.
    """
    n_sensors = len(samples.field_sr)
    count = np.bincount(samples.sensor, minlength=n_sensors).astype(float)
    density = np.maximum(count, 1.0) / samples.field_sr
    spread = np.empty(n_sensors)
    rate = _rates(samples)
    for s in range(n_sensors):
        own = rate[(samples.sensor == s) & np.isfinite(rate[:, 0])]
        # One made-up tracklet at 10 arcsec/s keeps the estimate sane where there are few.
        squares = np.sum((own - np.median(own, axis=0)) ** 2) / 2 if len(own) else 0.0
        spread[s] = np.sqrt((squares + (10 * np.pi / 648000) ** 2) / (len(own) + 1))
    volume = float(np.median(samples.field_sr)) * farthest_km**3 / 3
    return density, spread, max(float(np.median(count)), 1.0) / volume


def _rates(samples: Samples) -> Array:
    """Return each tracklet's mean rate [rad/s] between its first and last sample; NaN: one."""
    out = np.full((len(samples.sensor), 3), np.nan)
    for i, seen in enumerate(samples.seen):
        at = np.flatnonzero(seen)
        if len(at) > 1:
            dt = samples.time_s[at[-1]] - samples.time_s[at[0]]
            out[i] = (samples.u[i, at[-1]] - samples.u[i, at[0]]) / dt
    return out

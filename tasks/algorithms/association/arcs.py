"""Arcs: the odds of a hypothesis from several instants, tied together by one orbit.

An orbit has six parameters, whatever the number of instants. An unrelated tracklet has four more,
a position and a drift relative to the orbit; its other directions follow from these and are no
evidence. So two unrelated tracklets match by two coincidences (position and drift), not by one for
each instant.
"""

import numpy as np

from epipole.tasks.algorithms.association.views import PLANE, X, Y, direction, residual
from epipole.tasks.algorithms.constants import GM_KM3_S2, LN_2PI
from epipole.tasks.algorithms.earth_gravity import advance
from epipole.tasks.algorithms.kernels import kernel
from epipole.tasks.algorithms.orbit_linking.population import COMPONENTS, SHARE, SIGMA
from epipole.tasks.algorithms.symmetric_matrices import factor, substitute_forward

STEP_S = 60.0  # longest step of the propagation: one of a low orbit errs by 0.1 m
ITERATIONS = 6  # of Gauss and Newton, at most; three were enough in all scenes tried
CONVERGED = 1e-4  # decrease of chi-square below which a fit has converged: a hundredth of a sigma
RADIAL_SHARE = 0.6  # an orbiting object's 1-sigma radial velocity over that of a circular orbit
# An orbit is hyperbolic if its energy is above zero by this. With 1.5 and 6 all scenes tried come
# out the same.
SLACK_SIGMA = 3.0


@kernel
def _begin(views, x, seen_by, state):
    """Write a first state at the first solved instant; return its index.

    `state` (6,) [km, km/s], GCRF, is the straight line through the points `x` (k, 3) [km],
    corrected for gravity. `seen_by` (k,) as in `InstantPoints`; at least two instants must be
    solved.
    """
    first, n, mean_t = -1, 0, 0.0
    for m in range(len(views.time_s)):
        if seen_by[m] >= 2:
            if first < 0:
                first = m
            n += 1
            mean_t += views.time_s[m] - views.time_s[first]
    mean_t /= n
    state[:] = 0.0
    r2 = x[first, 0] ** 2 + x[first, 1] ** 2 + x[first, 2] ** 2
    gravity = GM_KM3_S2 / (r2 * np.sqrt(r2))
    square = 0.0
    for m in range(first, len(views.time_s)):
        if seen_by[m] < 2:
            continue
        t = views.time_s[m] - views.time_s[first]
        square += (t - mean_t) ** 2
        for a in range(3):
            straight = x[m, a] + 0.5 * gravity * x[first, a] * t * t
            state[a] += straight / n
            state[3 + a] += straight * (t - mean_t)
    for a in range(3):
        state[3 + a] /= square
        state[a] -= state[3 + a] * mean_t
    return first


@kernel
def _normal_equations(views, members, first, state, at, k, N, rhs):
    """Write the normal equations of the orbit; return chi-square, NaN behind a sensor.

    `N` (6, 6) and `rhs` (6,) are written, for the tracklets `members` (n,) and the orbit with the
    `state` (6,) [km, km/s], GCRF, at instant `first`. `at` receives its states, a row (6,) for each
    instant from there on; `k` (5, 6) is work space. The partials are those of motion in the gravity
    gradient at the first position, to the third order in time: good to 1 % over ten minutes of a
    low orbit.
    """
    N[:] = 0.0
    rhs[:] = 0.0
    part, y = np.empty(11), state.copy()
    G, H = np.empty((2, 6)), np.empty((2, 6))
    chi2 = 0.0
    r2 = y[0] * y[0] + y[1] * y[1] + y[2] * y[2]
    gravity = GM_KM3_S2 / (r2 * np.sqrt(r2))
    for m in range(first, len(views.time_s)):
        if m > first:
            advance(y, views.time_s[m] - views.time_s[m - 1], STEP_S, k)
        at[m] = y
        t = views.time_s[m] - views.time_s[first]
        for i in members:
            if not views.seen[i, m]:
                continue
            if residual(views, i, m, y, part) == 0.0:
                return np.nan
            for c in range(2):
                g = 2 + 3 * c
                tide = part[g] * state[0] + part[g + 1] * state[1] + part[g + 2] * state[2]
                for a in range(3):
                    bend = gravity * (3.0 * tide * state[a] / r2 - part[g + a])
                    G[c, a] = part[g + a] + bend * t * t / 2.0
                    G[c, 3 + a] = (part[g + a] + bend * t * t / 6.0) * t
            g0 = part[8] * part[0] + part[9] * part[1]
            g1 = part[9] * part[0] + part[10] * part[1]
            chi2 += part[0] * g0 + part[1] * g1
            for a in range(6):
                H[0, a] = part[8] * G[0, a] + part[9] * G[1, a]
                H[1, a] = part[9] * G[0, a] + part[10] * G[1, a]
                rhs[a] -= G[0, a] * g0 + G[1, a] * g1
            for a in range(6):
                for b in range(6):
                    N[a, b] += G[0, a] * H[0, b] + G[1, a] * H[1, b]
    return chi2


@kernel
def _ends(views, i, first):
    """Return the first and last instant, from `first` on, at which tracklet i is seen; else -1."""
    first_seen, last_seen = -1, -1
    for m in range(first, len(views.time_s)):
        if views.seen[i, m]:
            first_seen = m if first_seen < 0 else first_seen
            last_seen = m
    return first_seen, last_seen


@kernel
def _scatter(views, chance, i, last, first_seen, last_seen, b):
    """Write the drift from tracklet i to `last`, relative to their sensor's others.

    i and `last` are one tracklet, or the first and the last fragment of a track. `b` (3,) [rad/s],
    ICRS, is the mean rate of their direction between the instants `first_seen` and `last_seen`,
    minus the usual one. Return the variance of the drift [rad^2/s^2]: at least half the square of
    the drift, since a far outlier is rare by a power law, not by a Gaussian's tail.
    """
    s, dt = views.sensor[i], views.time_s[last_seen] - views.time_s[first_seen]
    square, u = 0.0, np.empty(3)
    direction(views, i, first_seen, u)
    direction(views, last, last_seen, b)
    for a in range(3):
        b[a] = (b[a] - u[a]) / dt - chance.drift[s, a]
        square += b[a] * b[a]
    return max(chance.spread[s] ** 2, square / 2.0)


@kernel
def _velocity_prior(views, chance, members, first, state, prior, prior_mean):
    """Write mean and inverse covariance of the velocity's prior; return its log norm.

    `prior_mean` (3,) [km/s] and `prior` (3, 3) [s^2/km^2], GCRF, are written, for the tracklets
    `members` (n,) and the first `state` (6,) [km, km/s], which is that of the instant `first`.

    Across the line of sight objects move like the tracklets of the sensor whose tracklets differ
    most; the norm includes that sensor's density at the drift of the first state. Along the line of
    sight they move as orbits allow.
    """
    radius = np.sqrt(state[0] ** 2 + state[1] ** 2 + state[2] ** 2)
    along = RADIAL_SHARE * np.sqrt(GM_KM3_S2 / radius)
    across, chosen, cost, b = 0.0, members[0], 0.0, np.empty(3)
    for i in members:
        first_seen, last_seen = _ends(views, i, first)
        if first_seen == last_seen:
            continue
        variance = _scatter(views, chance, i, i, first_seen, last_seen, b)
        scatter = _range(views, i, first_seen, state) * np.sqrt(variance)
        if scatter > across:
            across, chosen = scatter, i
            cost = 0.5 * (b[0] * b[0] + b[1] * b[1] + b[2] * b[2]) / variance
    if across == 0.0:
        across = along
    u, radial = np.empty(3), 0.0
    direction(views, chosen, _ends(views, chosen, first)[0], u)
    for a in range(3):
        radial += state[3 + a] * u[a]
    for a in range(3):
        prior_mean[a] = state[3 + a] - radial * u[a]
        for c in range(3):
            prior[a, c] = u[a] * u[c] * (1.0 / along**2 - 1.0 / across**2)
        prior[a, a] += 1.0 / across**2
    return -1.5 * LN_2PI - np.log(along) - 2.0 * np.log(across) - cost


@kernel
def _range(views, i, m, x):
    """Return the distance [km] of x from the sensor of tracklet i at instant m.

    `x` is a position (3,) [km] or a state (6,) [km, km/s], GCRF.
    """
    total = 0.0
    for a in range(3):
        total += (x[a] - views.camera[views.sensor[i], m, a]) ** 2
    return np.sqrt(total)


@kernel
def _unrelated_odds_of_sensor(views, chance, members, q, first, at):
    """Return the log-likelihood of a sensor's tracklets without the orbit: see `_unrelated_odds`.

    The sensor is that of ``members[q]``, of the tracklets `members` (n,). All of one sensor count
    with its first member, q; others give 0. They may be fragments of one unrelated object, or
    objects by themselves: the likelier of the two counts. Otherwise a track that breaks would be
    evidence again and again. Also returns by how much it is likelier than objects by themselves.
    """
    s, n = views.sensor[members[q]], 0
    for k in range(len(members)):
        if views.sensor[members[k]] == s:
            if k < q:
                return 0.0, 0.0
            n += 1
    if n == 1:
        return _unrelated_odds(views, chance, members[q : q + 1], first, at), 0.0
    fragments, n = np.empty(n, np.int64), 0
    for i in members:
        if views.sensor[i] == s:
            fragments[n] = i
            n += 1
    together = _unrelated_odds(views, chance, fragments, first, at)
    apart = 0.0
    for k in range(n):
        apart += _unrelated_odds(views, chance, fragments[k : k + 1], first, at)
    return max(together, apart), max(together - apart, 0.0)


@kernel
def _unrelated_odds(views, chance, fragments, first, at):
    """Return the log-likelihood of a sensor's tracklets as those of one unrelated object.

    It lies anywhere in the field and drifts like the sensor's other tracklets. Its position and
    drift are relative to the orbit with the states `at` (k, 6) [km, km/s], GCRF, from the instant
    `first` on, so the curvature of the path is common to both hypotheses. `fragments` (n,) are the
    tracklets.
    """
    s, i, last = views.sensor[fragments[0]], fragments[0], fragments[0]
    J, h, part = np.zeros((4, 4)), np.zeros(4), np.empty(11)
    first_seen, last_seen = -1, -1
    for k in fragments:
        begin, end = _ends(views, k, first)
        if begin >= 0 and (first_seen < 0 or begin < first_seen):
            first_seen, i = begin, k
        if end > last_seen:
            last_seen, last = end, k
    if first_seen < 0:
        return 0.0  # seen before `first` only, as the orbit is not
    variance, chi2, b = 1.0, 0.0, np.zeros(3)
    if first_seen < last_seen:
        variance = _scatter(views, chance, i, last, first_seen, last_seen, b)
    for c in range(2):
        # The residual drifts like the tracklet relative to the usual drift.
        mean = 0.0
        for a in range(3):
            mean += views.camera[s, first_seen, PLANE + 3 * c + a] * b[a]
        J[2 + c, 2 + c] = 1.0 / variance
        h[2 + c] = mean / variance
        chi2 += mean * mean / variance
    for k in fragments:
        for m in range(first_seen, last_seen + 1):
            if not views.seen[k, m]:
                continue
            residual(views, k, m, at[m], part)
            t = views.time_s[m] - views.time_s[first_seen]
            g0 = part[8] * part[0] + part[9] * part[1]
            g1 = part[9] * part[0] + part[10] * part[1]
            chi2 += part[0] * g0 + part[1] * g1
            for p, tp in ((0, 1.0), (2, t)):
                h[p] += tp * g0
                h[p + 1] += tp * g1
                for o, to in ((0, 1.0), (2, t)):
                    J[p, o] += tp * to * part[8]
                    J[p, o + 1] += tp * to * part[9]
                    J[p + 1, o] += tp * to * part[9]
                    J[p + 1, o + 1] += tp * to * part[10]
    solved = h.copy()
    log_det = factor(J, solved)
    for p in range(4):
        chi2 -= solved[p] * h[p]
    # The density is per area of the sky, the position one on the plane.
    flat = 1.0 + views.sight[i, first_seen, X] ** 2 + views.sight[i, first_seen, Y] ** 2
    prior = np.log(chance.density[s] / variance) - 1.5 * np.log(flat)
    return prior + LN_2PI - 0.5 * log_det - 0.5 * chi2


@kernel
def _is_hyperbolic(state, L):
    """Return whether the orbit is hyperbolic by 3 sigma.

    `state` (6,) [km, km/s], GCRF; `L` (6, 6) is its information, factored by `factor`.
    """
    r = np.sqrt(state[0] ** 2 + state[1] ** 2 + state[2] ** 2)
    v2 = state[3] ** 2 + state[4] ** 2 + state[5] ** 2
    slope, variance = np.empty(6), 0.0
    for a in range(3):
        slope[a] = GM_KM3_S2 * state[a] / r**3
        slope[3 + a] = state[3 + a]
    substitute_forward(L, slope)
    for a in range(6):
        variance += slope[a] * slope[a]
    return 0.5 * v2 - GM_KM3_S2 / r > SLACK_SIGMA * np.sqrt(variance)


@kernel
def _circular_odds(state, L):
    """Return the log-odds of orbits as objects have them over those of any eccentricity.

    Most orbits are nearly circular; lines of sight that meet by accident show any velocity. The
    velocities of objects are the mixture of `population`, those by accident its second component.

    `state` (6,) [km, km/s], GCRF; `L` (6, 6) is its information, factored by `factor`.
    """
    r = np.sqrt(state[0] ** 2 + state[1] ** 2 + state[2] ** 2)
    axes, radial, level = np.zeros((2, 6)), 0.0, 0.0  # of radial and horizontal velocity
    for a in range(3):
        axes[0, 3 + a] = state[a] / r
        radial += axes[0, 3 + a] * state[3 + a]
    for a in range(3):
        axes[1, 3 + a] = state[3 + a] - radial * axes[0, 3 + a]
        level += axes[1, 3 + a] ** 2
    level = np.sqrt(max(level, 1e-12))
    for a in range(3):
        axes[1, 3 + a] /= level
    circular, S = np.sqrt(GM_KM3_S2 / r), np.zeros((2, 2))  # covariance of the two
    substitute_forward(L, axes[0])
    substitute_forward(L, axes[1])
    for a in range(6):
        S[0, 0] += axes[0, a] ** 2
        S[0, 1] += axes[0, a] * axes[1, a]
        S[1, 1] += axes[1, a] ** 2
    off, of_component = level - circular, np.empty(COMPONENTS)
    for c in range(COMPONENTS):
        V0, V1 = S[0, 0] + (SIGMA[c] * circular) ** 2, S[1, 1] + (SIGMA[c] * circular) ** 2
        det = V0 * V1 - S[0, 1] ** 2
        chi2 = (V1 * radial**2 - 2.0 * S[0, 1] * radial * off + V0 * off**2) / det
        of_component[c] = -0.5 * (np.log(det) + chi2)
    return np.log(SHARE[1] + SHARE[0] * np.exp(of_component[0] - of_component[1]))


@kernel
def arc_odds(views, chance, members, points):
    """Return the log-odds of one orbit against unrelated tracklets, by the directions alone.

    Without the prior of the position and without misses (see `odds.score`). -inf where no orbit
    fits, or only a hyperbolic one. Also returns the log-odds that tracklets of one sensor are
    fragments of one object, which do not count for the orbit. `members` (n,) are the tracklets,
    `points` their `InstantPoints`, of which two or more are solved.
    """
    state, k = np.empty(6), np.empty((5, 6))
    at = np.empty((len(views.time_s), 6))
    N, rhs, prior, prior_mean = np.empty((6, 6)), np.empty(6), np.empty((3, 3)), np.empty(3)
    first = _begin(views, points.x_km, points.seen_by, state)
    log_prior = _velocity_prior(views, chance, members, first, state, prior, prior_mean)
    chi2 = log_det = gain = np.inf
    for _ in range(ITERATIONS):
        chi2 = _normal_equations(views, members, first, state, at, k, N, rhs)
        for a in range(3):
            for b in range(3):
                N[3 + a, 3 + b] += prior[a, b]
                rhs[3 + a] -= prior[a, b] * (state[3 + b] - prior_mean[b])
                chi2 += (
                    prior[a, b] * (state[3 + a] - prior_mean[a]) * (state[3 + b] - prior_mean[b])
                )
        if np.isnan(chi2):
            return -np.inf, 0.0
        gain = 0.0
        step = rhs.copy()
        log_det = factor(N, step)
        for a in range(6):
            gain += step[a] * rhs[a]
            state[a] += step[a]
        if not gain < 1e12:
            return -np.inf, 0.0
        if gain < CONVERGED:
            break
    if _is_hyperbolic(state, N):
        return -np.inf, 0.0
    total = log_prior + 3.0 * LN_2PI - 0.5 * log_det - 0.5 * (chi2 - gain)
    total += _circular_odds(state, N)
    fragments = 0.0
    for q in range(len(members)):
        unrelated, together = _unrelated_odds_of_sensor(views, chance, members, q, first, at)
        total -= unrelated
        fragments += together
    return total, fragments

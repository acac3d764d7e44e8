"""Checks of a sensor's states: units, reference frame, velocities, sigmas, jumps."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Nanoseconds
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM, GM_KM3_S2
from epipole.tasks.algorithms.log_checks.findings import (
    ONE_SENSOR,
    POSITION_SIGMA,
    POSITION_UNIT,
    REFERENCE_FRAME,
    SMOOTHNESS,
    SOUND,
    UNKNOWN,
    WRONG,
    Finding,
)
from epipole.tasks.algorithms.log_checks.free_fall import (
    OUTLIER,
    Arc,
    arcs_of,
    polynomial_residuals,
)
from epipole.tasks.algorithms.log_checks.readings import (
    CLEARLY,
    EARTH_FIXED,
    FAR,
    INERTIAL,
    ReadingFit,
    all_readings,
    fit_reading,
    in_other_frame,
    is_on_the_ground,
    main_readings,
    stated_reading,
    with_velocities,
)
from epipole.tasks.algorithms.log_checks.velocities import check_velocities

MIN_SCATTER_STATES = 20  # minimum length of an arc that shows the scatter
SCATTER_RATIO = 5.0  # scatter over stated sigma; the ratio of a sound log is smaller
MAX_OUTLIERS = 0.1  # share of the states; with more, the path itself is unknown
SMALLEST_JUMP_KM = 0.1  # minimum of a jump, and of what separates two paths
STEP_SHARE = 0.02  # of the way between two states: a polynomial is as good on the widest arcs
NO_FALL = 10.0  # misfit above which the unit of positions is unknown if no other unit fits
MIN_JUMP_STATES = 12  # minimum length of an arc that shows which of its states is off
MIN_SECOND_SHARE = 0.2  # minimum share of states on each of two paths, and of changes between them
MIN_ALTERNATING = 8  # minimum number of states that show two paths
MAX_SECOND = 400  # maximum number of states that are searched for a second path
FAR_STEP = 10.0  # times the usual distance of neighbours: not on the same path


class LogStates(NamedTuple):
    """All states of one sensor as its log has them, sorted by time, repeats included.

    time_ns : (n,) int
    r_km, v_km_s : (n, 3) float
        In the stated frame, as if in km and km/s; NaN where there is no velocity.
    sigma_km : (n,) float
        Stated 1-sigma error per axis; 0 where unknown.
    earth_fixed : bool
        Whether the stated frame turns with the Earth.
    """

    time_ns: Nanoseconds
    r_km: Array
    v_km_s: Array
    sigma_km: Array
    earth_fixed: bool


def check_states(states: LogStates) -> list[Finding]:
    """Return the findings of a sensor's states; none without states."""
    if not len(states.time_ns):
        return []
    two = _two_paths(states)
    if two.verdict == WRONG:
        return [two]
    once = np.flatnonzero(np.diff(states.time_ns, prepend=states.time_ns[0] - 1))
    states = states._replace(**{
        name: getattr(states, name)[once] for name in ("time_ns", "r_km", "v_km_s", "sigma_km")
    })  # fmt: skip
    arcs = arcs_of(*states[:4])
    if not arcs:
        return [two, _bound(states)]
    jumps, arcs, scatter_km = _jumps(arcs)
    if is_on_the_ground(arcs):
        ground = [
            Finding(name, UNKNOWN, cause="on_the_ground")
            for name in (POSITION_UNIT, REFERENCE_FRAME)
        ]
        return [two, jumps, *ground, _sigma(arcs, scatter_km)]
    scale, found = _readings(arcs, states.earth_fixed)
    return [two, jumps, *found, _sigma(arcs, scatter_km * scale)]


def _readings(arcs: Sequence[Arc], earth_fixed: bool) -> tuple[float, list[Finding]]:
    """Return the unit of positions [km], and the findings on unit, frame and velocities."""
    stated = fit_reading(arcs, stated_reading(earth_fixed))
    others = _others(arcs, stated)
    best = _chosen(stated, others)
    velocity = check_velocities(best.arcs)
    if velocity.verdict == SOUND:
        were_far, stated = stated.misfit > FAR, with_velocities(stated)
        if stated.misfit > FAR and not were_far:
            others = _others(arcs, stated)
        others = [with_velocities(fit) for fit in others]
        best = _chosen(stated, others)
    findings = [_unit(stated, others, best), _frame(stated, others, best), velocity]
    return best.reading.scale, findings


def _others(arcs: Sequence[Arc], stated: ReadingFit) -> list[ReadingFit]:
    """Return the fits of other readings: of all where the stated one is far off."""
    find_others = all_readings if stated.misfit > FAR else main_readings
    return [fit_reading(arcs, reading) for reading in find_others(stated.reading)]


def _chosen(stated: ReadingFit, others: Sequence[ReadingFit]) -> ReadingFit:
    """Return the stated reading unless it does not fit and another does."""
    if stated.misfit <= FAR:
        return stated
    fitting = [fit for fit in others if fit.misfit <= min(1.0, CLEARLY * stated.misfit)]
    if not fitting:
        return stated
    same_unit = [fit for fit in fitting if fit.reading.has_unit_of(stated.reading)]
    # With the unit alone wrong, the frame is as stated.
    same_axes = [fit for fit in fitting if fit.reading.has_axes_of(stated.reading)]
    return min(same_unit or same_axes or fitting, key=lambda fit: fit.misfit)


def _unit(stated: ReadingFit, others: Sequence[ReadingFit], best: ReadingFit) -> Finding:
    """Return the finding on the unit of positions."""
    found = Finding(POSITION_UNIT, SOUND, best.share, best.share_sigma, 0.0)
    if not best.reading.has_unit_of(stated.reading):
        return found._replace(verdict=WRONG, cause="positions_in_m", value=stated.share)
    if stated.misfit > NO_FALL and best.reading.has_axes_of(stated.reading):
        return found._replace(verdict=UNKNOWN, cause="no_free_fall")
    other_unit = [fit for fit in others if not fit.reading.has_unit_of(stated.reading)]
    if min(fit.misfit for fit in other_unit) <= 1.0:
        return found._replace(verdict=UNKNOWN, cause="arc_too_short")
    return found


def _frame(stated: ReadingFit, others: Sequence[ReadingFit], best: ReadingFit) -> Finding:
    """Return the finding on the frame of positions, which are in the unit of the best reading."""
    of_unit = [fit for fit in (stated, *others) if fit.reading.has_unit_of(best.reading)]
    as_stated = next(fit for fit in of_unit if fit.reading.has_axes_of(stated.reading))
    found = Finding(REFERENCE_FRAME, SOUND, as_stated.share, as_stated.share_sigma, 0.0)
    if not best.reading.has_axes_of(stated.reading):
        return found._replace(verdict=WRONG, cause=_frame_cause(best.reading.rate_rad_s))
    other_frame = in_other_frame(stated.reading)
    if any(fit.misfit <= 1.0 for fit in of_unit if fit.reading.has_axes_of(other_frame)):
        return found._replace(verdict=UNKNOWN, cause="arc_too_short")
    if as_stated.misfit > 1.0:
        return found._replace(verdict=UNKNOWN, cause="no_free_fall")
    return found


def _frame_cause(rate: Array) -> str:
    if np.array_equal(rate, INERTIAL):
        return "inertial_states"
    if np.array_equal(rate, EARTH_FIXED):
        return "earth_fixed_states"
    return "position_axes"


def _bound(states: LogStates) -> Finding:
    """Return what few states say of their unit: whether their orbits are bound."""
    speed2 = (states.v_km_s**2).sum(axis=1)
    if not np.isfinite(speed2).any():
        return Finding(POSITION_UNIT, UNKNOWN, cause="too_few_states")
    known = np.isfinite(speed2)
    radius = np.linalg.norm(states.r_km[known], axis=1)
    if states.earth_fixed:
        turning = np.cross(EARTH_FIXED, states.r_km[known])
        speed2 = ((states.v_km_s[known] + turning) ** 2).sum(axis=1)
    else:
        speed2 = speed2[known]
    bound = float(np.median(speed2 * radius / (2 * GM_KM3_S2)))  # 1: it just escapes
    found = Finding(POSITION_UNIT, SOUND, bound, expected=0.5, cause="")
    if 0.1 < bound < 1.0 and np.median(radius) > EARTH_RADIUS_KM:
        return found
    return found._replace(verdict=UNKNOWN, cause="too_few_states")


def _jumps(arcs: Sequence[Arc]) -> tuple[Finding, list[Arc], float]:
    """Return the finding on jumps, the arcs without outliers, and the scatter [km]."""
    kept, outliers, total, scatters, largest = [], 0, 0, [], 0.0
    for arc in arcs:
        residual, scatter = polynomial_residuals(arc)
        scatters.append(scatter)
        if len(arc.t_s) < MIN_JUMP_STATES:
            kept.append(arc)
            continue
        step = float(np.median(np.linalg.norm(np.diff(arc.r, axis=0), axis=1)))
        allowed = max(OUTLIER * scatter, OUTLIER * arc.sigma, SMALLEST_JUMP_KM, STEP_SHARE * step)
        off = np.abs(residual).max(axis=1)  # on the worst axis [km]
        good = off <= allowed
        outliers += int((~good).sum())
        total += len(good)
        largest = max(largest, float(off[~good].max(initial=0.0)))
        no_path = good.sum() < len(good) * (1 - MAX_OUTLIERS)
        kept.append(arc if no_path else Arc(arc.t_s[good], arc.r[good], arc.v[good], arc.sigma))
    # The polynomial of a short arc may be farther off than its states are.
    of_long = [
        scatter
        for scatter, arc in zip(scatters, arcs, strict=True)
        if len(arc.t_s) >= MIN_SCATTER_STATES
    ]
    scatter_km = float(np.median(of_long or scatters))
    found = Finding(SMOOTHNESS, SOUND, outliers, expected=0.0, facts={"states": total})
    if not total:
        found = found._replace(verdict=UNKNOWN, value=float("nan"), cause="too_few_states")
    elif 0 < outliers <= MAX_OUTLIERS * total:
        facts = {"states": total, "jump_km": largest}
        found = found._replace(verdict=WRONG, cause="states_jump", facts=facts)
    elif outliers:
        found = found._replace(verdict=UNKNOWN, cause="no_path")
    return found, kept, scatter_km


def _sigma(arcs: Sequence[Arc], scatter_km: float) -> Finding:
    """Return whether the stated sigma is that of the positions, as far as their scatter shows."""
    sigma_km = float(np.median([arc.sigma for arc in arcs]))
    n = sum(len(arc.t_s) for arc in arcs)
    error_km = scatter_km / np.sqrt(2 * max(3 * n, 1))
    found = Finding(POSITION_SIGMA, SOUND, scatter_km, error_km, sigma_km, "km")
    if max(len(arc.t_s) for arc in arcs) < MIN_SCATTER_STATES:
        return found._replace(verdict=UNKNOWN, cause="too_few_states")
    if sigma_km <= 0:
        return found._replace(verdict=UNKNOWN, expected=float("nan"), cause="no_sigma")
    if scatter_km > SCATTER_RATIO * sigma_km:
        return found._replace(verdict=WRONG, cause="sigma_too_small")
    return found


def _two_paths(states: LogStates) -> Finding:
    """Return whether states of two satellites have one id: they alternate between two paths."""
    found = Finding(ONE_SENSOR, SOUND, 0.0, expected=0.0)
    n = len(states.time_ns)
    t, r = states.time_ns, states.r_km
    same = np.flatnonzero(np.diff(t) == 0)
    apart = np.linalg.norm(r[same + 1] - r[same], axis=1)
    twice = apart > 10 * states.sigma_km[same] + SMALLEST_JUMP_KM
    if twice.sum() >= max(MIN_SECOND_SHARE * n / 2, 3):
        facts = {"states": n, "apart_km": float(np.median(apart[twice]))}
        return found._replace(
            verdict=WRONG, value=int(twice.sum()), cause="two_sensors", facts=facts
        )
    middle = slice(max(n // 2 - MAX_SECOND // 2, 0), n // 2 + MAX_SECOND // 2)
    second = _second_path(r[middle])
    if not second.any():
        return found
    facts = {"states": len(second), "apart_km": _apart(r[middle], second)}
    return found._replace(verdict=WRONG, value=int(second.sum()), cause="two_sensors", facts=facts)


def _second_path(r_km: Array) -> Flags:
    """Return which states belong to a second path; none where one path is enough.

    The first state that is far from the one before begins the second path. From there on a state
    that is far from the last one of its path belongs to the other one if that is nearer. There are
    two paths only if they alternate: after a gap in one path, all states are on the second.
    """
    n = len(r_km)
    second = np.zeros(n, bool)
    if n < MIN_ALTERNATING:
        return second
    # Distance to the nearest of the next three states: one of these is on the same path.
    nearest = np.min([
        np.linalg.norm(r_km[k : n - 3 + k] - r_km[: n - 3], axis=1) for k in (1, 2, 3)
    ], axis=0)  # fmt: skip
    far = FAR_STEP * float(np.median(nearest)) + SMALLEST_JUMP_KM
    if (np.linalg.norm(np.diff(r_km, axis=0), axis=1) <= far).all():
        return second
    last, other = r_km[0], None  # last states of the path of the state before, of the other path
    for k in range(1, n):
        to_last = float(np.linalg.norm(r_km[k] - last))
        to_other = np.inf if other is None else float(np.linalg.norm(r_km[k] - other))
        if to_last <= far or to_last <= to_other < np.inf:
            second[k], last = second[k - 1], r_km[k]
        else:
            second[k], last, other = not second[k - 1], r_km[k], last
    switches = int((np.diff(second.astype(int)) != 0).sum())
    share = float(second.mean())
    if min(share, 1 - share, switches / n) < MIN_SECOND_SHARE:
        return np.zeros(n, bool)
    return second


def _apart(r_km: Array, second: Flags) -> float:
    """Return the typical distance of states that follow each other on different paths [km]."""
    switch = np.flatnonzero(np.diff(second.astype(int)))
    return float(np.median(np.linalg.norm(r_km[switch + 1] - r_km[switch], axis=1)))

"""Initiation: the tracks that begin are those of following every pair of detections back."""

from typing import NamedTuple

import numpy as np
import pytest

from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.directions import tangent_basis
from epipole.tasks.algorithms.tracking.initiation import (
    APART,
    EXTRA_DETECTIONS,
    FAINT_APART,
    FAINT_FRAMES,
    MAX_FAINT_MISSES,
    MAX_FREE,
    MIN_BEHIND_GAP,
    NONE,
    P_FAINT,
    Detections,
    RecentFrames,
    TrackRule,
    new_tracks,
)
from epipole.tasks.algorithms.tracking.runs import SLACK_FRAMES, _fill_frame
from epipole.tasks.algorithms.tracking.sky_filter import acceleration, jerk_of, make_grids

FIELD_RAD = np.radians(4.0)
P_DETECTION = 0.9
TIMES = {
    "even": [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
    "uneven": [0.0, 0.7, 2.0, 2.4, 4.1, 5.0, 6.3],
    "twice": [0.0, 1.0, 2.0, 2.0, 3.0, 4.0, 5.0],
    "gap": [0.0, 1.0, 6.0, 7.0, 8.0, 9.0, 10.0],
    "gaps": [0.0, 5.0, 10.0, 11.0, 12.0, 13.0, 14.0],
}


def rule(**changes):
    options = {
        "max_rate": np.radians(2.0),
        "max_coast": np.full(7, 4.5),
        "max_missed": 3,
        "min_detections": 3,
        "gate2": 16.0,
        "field_sr": FIELD_RAD**2,
        "min_evidence": -np.log(1e-2),
        "max_pairs": 5000.0,
    }
    return TrackRule(**options | changes)


def scene(seed, *, times, rate_arcsec_s, n_objects=2, n_strays=2, missed=0.1, errors=(1.0, 4.0)):
    """Return detections of a few frames: objects on curved paths, strays, some that have a track.

    Their errors are between `errors` [arcsec].
    """
    rng = np.random.default_rng(seed)
    centre = rng.normal(size=3)
    centre /= np.linalg.norm(centre)
    start = rng.uniform(-0.3, 0.3, (n_objects, 2)) * FIELD_RAD
    heading = rng.uniform(0, 2 * np.pi, n_objects)
    rate = rate_arcsec_s * ARCSEC * np.column_stack([np.cos(heading), np.sin(heading)])
    bend = rng.uniform(-0.5, 0.5, (n_objects, 2)) * acceleration(rate_arcsec_s * ARCSEC)
    offsets, u, sigma = [0], [], []
    for t in times:
        strays = rng.uniform(-0.5, 0.5, (rng.poisson(n_strays), 2)) * FIELD_RAD
        at = np.vstack([start + rate * t + bend * t**2 / 2, strays])
        at = rng.permutation(at[rng.random(len(at)) > missed])
        sigma.append(rng.uniform(*errors, len(at)) * ARCSEC)
        at = at + rng.normal(size=at.shape) * sigma[-1][:, None]
        u.append(centre + at @ tangent_basis(centre))
        offsets.append(offsets[-1] + len(at))
    u = np.concatenate(u)
    track = np.where(rng.random(len(u)) < 0.05, 7, NONE)
    return Detections(
        times=np.array(times),
        offsets=np.array(offsets),
        frame_of=np.repeat(np.arange(len(times)), np.diff(offsets)),
        directions=u / np.linalg.norm(u, axis=1, keepdims=True),
        variances=np.concatenate(sigma) ** 2,
        log_flux=np.full(len(u), np.nan),
        track=track,
    )


def begun_in_last_frame(detections, of):
    """Return the members of the new tracks that end in the last frame, in order."""
    n_slots = max(of.min_detections + EXTRA_DETECTIONS, FAINT_FRAMES) + 1
    recent = RecentFrames(
        make_grids(n_slots, int(np.diff(detections.offsets).max())),
        np.full(n_slots, np.inf),
        np.zeros(n_slots),
    )
    f = len(detections.times) - 1
    for k in range(f + 1):
        _fill_frame(k, detections, recent)
    depth, n_tracks = of.min_detections + SLACK_FRAMES, 100
    begun, length, members = new_tracks(f, depth, n_tracks, detections, recent, of)
    tracks = [members[row, : length[row]].tolist() for row in begun]
    for k, track in enumerate(tracks):
        assert np.flatnonzero(detections.track == n_tracks + k).tolist() == sorted(track)
    return tracks


class State(NamedTuple):
    """Direction, rate [1/s] and acceleration [1/s^2], (3,) each; covariance (3, 3) of one axis."""

    u: np.ndarray
    w: np.ndarray
    bend: np.ndarray
    P: np.ndarray


def begin(u_1, t_1, var_1, u_2, t_2, var_2):
    """Return the state at the second of two directions."""
    dt, across = t_2 - t_1, u_2 * (u_1 @ u_2) - u_1
    angle = np.arctan2(np.linalg.norm(across), u_1 @ u_2)
    a = acceleration(abs(angle / dt))
    # Errors of the state by those of both directions and by the unknown acceleration.
    G = np.array([[0.0, 1.0, 0.0], [-1 / dt, 1 / dt, dt / 2], [0.0, 0.0, 1.0]])
    w = across / np.linalg.norm(across) * angle / dt
    return State(u_2, w, np.zeros(3), G @ np.diag([var_1, var_2, a**2]) @ G.T)


def predict(state, dt):
    u, w, bend, P = state
    rate = np.linalg.norm(w)
    F = np.array([[1.0, dt, dt**2 / 2], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    noise = jerk_of(rate, np.linalg.norm(bend)) * np.array([dt**3 / 6, dt**2 / 2, dt])
    angle, ahead = rate * dt, w / rate
    moved = u * np.cos(angle) + ahead * np.sin(angle) + bend * dt**2 / 2
    w = w * np.cos(angle) - u * rate * np.sin(angle) + bend * dt
    return straight(moved, w, bend, F @ P @ F.T + np.outer(noise, noise))


def correct(state, measured, variance):
    u, w, bend, P = state
    gain = P[0] / (P[0, 0] + variance)
    off = measured - u
    P = P - np.outer(gain, P[0])
    return straight(u + gain[0] * off, w + gain[1] * off, bend + gain[2] * off, P)


def straight(u, w, bend, P):
    u = u / np.linalg.norm(u)
    return State(u, w - w @ u * u, bend - bend @ u * u, P)


def free_in(detections, f):
    lo, hi = detections.offsets[f : f + 2]
    return [j for j in range(lo, hi) if detections.track[j] == NONE]


def is_sparse(detections, f):
    return len(free_in(detections, f)) <= MAX_FREE


def follow_back(detections, of, f, j, g, i):
    """Return the members and log-evidence of a pair that is followed to the first frame.

    The evidence is that of the better of two probabilities of detection.
    """
    times, u, var = detections.times, detections.directions, detections.variances
    detected = np.array([P_DETECTION, P_FAINT])
    evidence = np.array([0.0, np.log(0.5) if is_sparse(detections, f) else -np.inf])
    evidence += (f - g - 1) * np.log(1 - detected)
    state = begin(u[j], times[f], var[j], u[i], times[g], var[i])
    members, misses, at = [j, i], 0, times[g]
    near, evidence_near = members, -np.inf  # on this side of a gap
    for h in range(g - 1, -1, -1):
        if times[h] == at:
            continue
        if is_sparse(detections, f) and misses == MAX_FAINT_MISSES:
            break
        if at - times[h] > of.max_coast[-1]:
            if max(evidence) - evidence_near < MIN_BEHIND_GAP:
                break
            near, evidence_near = members, max(evidence)
        state, at = predict(state, times[h] - at), times[h]
        free, after = free_in(detections, h), np.full(2, -np.inf)
        chi2 = [np.sum((u[m] - state.u) ** 2) / (state.P[0, 0] + var[m]) for m in free]
        if free and min(chi2) < of.gate2:
            m = free[int(np.argmin(chi2))]
            spot = 2 * np.pi * (state.P[0, 0] + var[m])
            odds = detected / (len(free) / of.field_sr * spot)
            after = evidence + misses * np.log(1 - detected) + np.log(odds) - min(chi2) / 2
        if max(after) < max(evidence):
            misses += 1
            continue
        evidence, misses = after, 0
        state, members = correct(state, u[m], var[m]), [*members, m]
    if max(evidence) - evidence_near < MIN_BEHIND_GAP:
        return near, evidence_near
    return members, max(evidence)


def by_trying_all(detections, of):
    """Return the members of the new tracks: of every pair in the last frames, whatever its rate."""
    times, u, f, best = detections.times, detections.directions, len(detections.times) - 1, {}
    for g in range(f - 1, f - 1 - (FAINT_APART if is_sparse(detections, f) else APART), -1):
        dt = times[f] - times[g]
        if not 0.0 < dt <= of.max_coast[-1]:
            continue
        ends, starts = free_in(detections, f), free_in(detections, g)
        by_chance = np.log(max(len(ends), 1) * max(len(starts), 1))
        for j in ends:
            for i in starts:
                if np.linalg.norm(u[i] - u[j]) > of.max_rate * dt:
                    continue
                members, evidence = follow_back(detections, of, f, j, g, i)
                strength = evidence - by_chance
                if len(members) >= of.min_detections and strength > max(
                    of.min_evidence, best.get(j, (-np.inf,))[0]
                ):
                    best[j] = strength, members
    tracks, used = [], set()
    for _, members in sorted(best.values(), key=lambda chain: -chain[0]):
        if used.isdisjoint(members):
            tracks.append(members)
            used.update(members)
    return tracks


@pytest.mark.parametrize("rate_arcsec_s", [0.0, 5.0, 60.0, 900.0, 3000.0])
@pytest.mark.parametrize("times", TIMES)
def test_no_track_is_lost_by_the_pairs_that_are_skipped(times, rate_arcsec_s):
    n_begun = 0
    for seed in range(12):
        detections = scene(seed, times=TIMES[times], rate_arcsec_s=rate_arcsec_s)
        # All frames are followed back where at least 3 detections are needed. Where the demand is
        # strong, a miss rules a pair out.
        of = rule(min_detections=3 + seed % 2, min_evidence=5.0 + 8.0 * (seed % 6))
        expected = by_trying_all(detections, of)
        assert begun_in_last_frame(detections, of) == expected, seed
        n_begun += len(expected)
    assert n_begun > 4


@pytest.mark.parametrize("n_objects", [0, 4])
def test_weak_chains_among_strays_are_those_of_trying_all_pairs(n_objects):
    n_begun = 0
    for seed in range(30):
        # Large errors, many misses, a weak demand: chains are near the limit, chance begins some.
        detections = scene(
            seed,
            times=TIMES["even"],
            rate_arcsec_s=300.0 * (seed % 3),
            n_objects=n_objects,
            n_strays=12,
            missed=0.3,
            errors=(80.0, 81.0 + 80.0 * (seed % 2)),
        )
        of = rule(min_evidence=np.log(0.3) + seed % 5 * (n_objects > 0))
        expected = by_trying_all(detections, of)
        assert begun_in_last_frame(detections, of) == expected, seed
        n_begun += len(expected)
    assert n_begun > 5

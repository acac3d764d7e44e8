"""Common motion: what all objects of a sensor do that are far away and near each other.

At one frame in many seconds, the next position of a new track is uncertain by more than the
distance of co-located satellites, because the sensor's acceleration shifts it. But it shifts
all of them alike. Their second differences, from frame to frame, show this acceleration. Seen from
a frame that moves with them, they hardly move, and which detection belongs to which is clear.
"""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Flags, Indices
from epipole.tasks.algorithms.tracking.sky_filter import acceleration

MIN_TRACKS = 4  # minimum number of tracks that show the common acceleration of a frame
MIN_SHOWN = 0.5  # minimum share of the frames in which it is shown
ROUNDS = 5  # of robust means
SMOOTHED_S = 60.0  # time on each side in which it is smoothed; it turns by 1e-3 rad/s
BEGIN_FRAMES = 3  # frames at the beginning that tell the rate there
MAX_SCATTER = 3.0  # maximum scatter of second differences, over that of their errors


class CommonMotion(NamedTuple):
    """A frame of reference that moves with the objects.

    rotation : (f, 3, 3) float
        From ICRS to it, for each frame.
    rate : float
        Median rate of the objects [rad/s].
    """

    rotation: Array
    rate: float


def common_motion(
    time_s: Array, offsets: Indices, u_icrs: Array, sigma_rad: Array, track: Indices
) -> CommonMotion | None:
    """Return the common motion of tracks; None where they show none, or it is not needed.

    It is needed where the acceleration that a rate allows exceeds the error of a detection between
    two frames.

    Parameters
    ----------
    time_s, offsets, u_icrs, sigma_rad
        As in `SkyDetections`.
    track : (n,) int
        Track of each detection, -1 without a track. Some may be mixed: means are robust.
    """
    frame = np.repeat(np.arange(len(time_s)), np.diff(offsets))
    rows = np.flatnonzero(track >= 0)
    rows = rows[np.lexsort((frame[rows], track[rows]))]
    one, two = rows[:-1], rows[1:]
    next_to = (track[one] == track[two]) & (frame[two] == frame[one] + 1)
    if next_to.sum() < MIN_TRACKS:
        return None
    dt = time_s[frame[two]] - time_s[frame[one]]
    w = (u_icrs[two] - u_icrs[one]) / np.where(next_to, dt, 1.0)[:, None]
    rate = float(np.median(np.linalg.norm(w[next_to], axis=1)))
    step_s, sigma = float(np.median(dt[next_to])), float(np.median(sigma_rad))
    if 0.5 * acceleration(rate) * step_s**2 < sigma:
        return None
    triple = np.flatnonzero(next_to[:-1] & next_to[1:])
    middle = two[triple]
    bend = 2 * (w[triple + 1] - w[triple]) / (dt[triple] + dt[triple + 1])[:, None]
    by_frame = np.argsort(frame[middle], kind="stable")
    ends = np.searchsorted(frame[middle][by_frame], np.arange(1, len(time_s)))
    shown = np.split(by_frame, ends)
    bends = np.full((len(time_s), 3), np.nan)
    for f, at in enumerate(shown):
        if len(at) >= MIN_TRACKS:
            bends[f], scatter = _robust_mean(bend[at], u_icrs[middle[at]])
            if scatter * step_s**2 > MAX_SCATTER * np.sqrt(6.0) * sigma:
                bends[f] = np.nan
    good = np.isfinite(bends[:, 0])
    if good.sum() < max(MIN_SHOWN * (len(time_s) - 2), 1):
        return None
    begin = next_to & (frame[one] < frame[one].min() + BEGIN_FRAMES)
    if not begin.any():  # the first frames are too far apart to tell the rate there
        return None
    bends = _smoothed(time_s, bends, good)
    start, _ = _robust_mean(w[begin], u_icrs[one[begin]])
    return CommonMotion(_rotations(time_s, u_icrs[rows].mean(axis=0), start, bends), rate)


def _robust_mean(values: Array, u: Array) -> tuple[Array, float]:
    """Return the vector (3,) whose parts across the directions u are the values, and the scatter.

    The scatter is the median distance. Values far beyond it do not count.
    """
    across = np.eye(3) - u[:, :, None] * u[:, None, :]
    mean_u = u.mean(axis=0)
    weight = np.ones(len(u))
    mean, distance = np.median(values, axis=0), np.zeros(len(u))
    for _ in range(ROUNDS):
        distance = np.linalg.norm(np.einsum("nij,nj->ni", across, values - mean), axis=1)
        weight = 1 / (1 + (distance / max(3 * np.median(distance), 1e-300)) ** 2) ** 2
        normal = np.einsum("n,nij->ij", weight, across) + weight.sum() * np.outer(mean_u, mean_u)
        mean = np.linalg.solve(normal, np.einsum("n,nij,nj->i", weight, across, values))
    return mean, float(np.median(distance))


def _smoothed(time_s: Array, values: Array, good: Flags) -> Array:
    """Return values (f, 3) smoothed by lines through those around each time; gaps are filled.

    Twice: errors of successive second differences then nearly cancel, so that the frame of
    reference moves as smoothly as a track.
    """
    out = np.stack([np.interp(time_s, time_s[good], values[good, a]) for a in range(3)], axis=1)
    for _ in range(2):
        before = out.copy()
        for f, t in enumerate(time_s):
            near = np.abs(time_s - t) <= SMOOTHED_S
            dt, mean = time_s[near] - time_s[near].mean(), before[near].mean(axis=0)
            slope = dt @ before[near] / max(dt @ dt, 1e-9)
            out[f] = mean + slope * (t - time_s[near].mean())
    return out


def _rotations(time_s: Array, g: Array, w: Array, bends: Array) -> Array:
    """Return the rotations that hold a direction g in place, which moves with rate w and bends."""
    g = g / np.linalg.norm(g)
    w = w - (w @ g) * g
    R = np.tile(np.eye(3), (len(time_s), 1, 1))
    for f in range(len(time_s) - 1):
        dt = time_s[f + 1] - time_s[f]
        step = dt * w + dt * dt / 6 * (2 * bends[f] + bends[f + 1])
        ahead = g + step - (step @ g) * g
        ahead /= np.linalg.norm(ahead)
        R[f + 1] = R[f] @ _turn(ahead, g)
        w = w + dt / 2 * (bends[f] + bends[f + 1])
        g, w = ahead, w - (w @ ahead) * ahead
    return R


def _turn(a: Array, b: Array) -> Array:
    """Return the smallest rotation that takes unit vector a to b."""
    axis, cosine = np.cross(a, b), float(a @ b)
    skew = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + cosine))

"""Checks of a sensor's frames: their times, beside those of the states, and what they hold."""

from typing import NamedTuple

import numpy as np

from epipole.schemas.arrays import Array, Integers, Nanoseconds
from epipole.tasks.algorithms.constants import SECOND_NS
from epipole.tasks.algorithms.log_checks.findings import (
    CALIBRATION,
    CENTROID_SIGMA,
    COVERAGE,
    EXPOSURE_TIME,
    FLUX,
    FRAME_TIMES,
    FRAMES_ALL_NIGHT,
    IMAGE_SIZE,
    ONE_SENSOR,
    PRINCIPAL_POINT,
    SOUND,
    UNKNOWN,
    WRONG,
    Finding,
)

# Offsets between time scales in use, and of clocks that show local time: GPS and TAI minus UTC,
# TAI minus GPS, hours.
GPS_S, TAI_S, TAI_GPS_S = 18.0, 37.0, 19.0
HOUR_S = 3600.0
NEAR_OFFSET_S = 2.0  # recorders start and stop states and frames within this time
QUANTA_NS = (SECOND_NS, SECOND_NS // 10)  # of times that are cut or rounded
COMB_NS = 1_000  # rounding of a time in floating seconds
MIN_FRAMES = 20
MIN_REPEATED = 0.2  # share of the frames whose time is that of another one
MIN_BACKWARD = 0.2  # share of the steps at which the frame number does not grow
MIN_FLUXES = 50
GAP_FRAMES = 10  # a time without frames that is this many frame intervals long is a gap
SHORTEST_GAP_S = 5.0
MAGNITUDES = (-5.0, 20.0)
# Where the median lies between the smallest and the largest: faint stars are many. Half of them
# are within a magnitude of the limit; of linear fluxes the median is near the smallest.
MAGNITUDE_SHARE = 0.4
# Median exposure over the median time from frame to frame: exposures of some cameras last until the
# next one begins, and intervals vary.
LONGEST_EXPOSURE = 1.2
OUTSIDE = 0.02  # share of centroids outside the image
LEAST_SIGMA_PX = 0.001  # stated error of a centroid that no camera reaches: a run ignores less
# Scatter of stars over stated errors, either way, that is a mistake: photons alone may be a third
# of the error, and a run scales errors by itself. Degrees of freedom of residuals that show it.
SIGMA_RATIO, MIN_SCATTER_DOF = 5.0, 20
REACH = 0.45  # of a side that no centroid exceeds: the image is larger than stated, or smaller


class LogFrames(NamedTuple):
    """The frames of one sensor, sorted by time.

    time_ns, number : (n,) int
        One frame of each time.
    all_numbers : (k,) int
        Of all frames in order of time, also where several have one time.
    x_px, y_px, flux, sigma_px : (m,) float
        Centroids of some of the frames; flux and sigma_px only those that are known, (k,) each.
    exposure_s : (s,) float
        Exposure times of these frames; 0 is unknown.
    """

    time_ns: Nanoseconds
    number: Integers
    all_numbers: Integers
    x_px: Array
    y_px: Array
    flux: Array
    sigma_px: Array
    exposure_s: Array


class LogCamera(NamedTuple):
    """The first calibration of a sensor, and how many others of the same time differ from it.

    `width` and `height` are those of its largest image.
    """

    width: float
    height: float
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    others: int


def check_frames(
    frames: LogFrames, state_ns: Nanoseconds, camera: LogCamera | None, state_gap_s: float
) -> list[Finding]:
    """Return the findings of a sensor's frames; none without frames."""
    if not len(frames.time_ns):
        return []
    found = [check_times(frames), *check_coverage(frames.time_ns, state_ns, state_gap_s)]
    two_sensors = check_numbers(frames, camera)
    found += two_sensors or check_exposures(frames)
    if camera is None:
        facts = {"frames": float(len(frames.time_ns))}
        found.append(
            Finding(CALIBRATION, WRONG, 0.0, expected=1.0, cause="no_calibration", facts=facts)
        )
    else:
        found += [check_principal_point(camera), check_image_size(frames, camera)]
    return [*found, check_flux(frames.flux), check_stated_sigma(frames.sigma_px)]


def check_times(frames: LogFrames) -> Finding:
    """Return whether times are cut or rounded: multiples of a second, or of a tenth."""
    quantum_ns = next((q for q in QUANTA_NS if _is_comb(frames.time_ns, q)), 0)
    found = Finding(FRAME_TIMES, SOUND, quantum_ns / SECOND_NS, expected=0.0, unit="s")
    n = len(frames.time_ns)
    if not quantum_ns or n < 2:
        return found._replace(value=0.0)
    if n < MIN_FRAMES:
        return found._replace(verdict=UNKNOWN, cause="whole_times")
    repeated = len(frames.all_numbers) - n
    facts = {"frames": float(n + repeated), "repeated": float(repeated)}
    if repeated > MIN_REPEATED * n:
        return found._replace(verdict=WRONG, cause="times_cut", facts=facts)
    # Times of a regular cadence, cut: each is within one quantum of a straight line, and they
    # are not themselves regular.
    steps = np.diff(frames.number)
    k = frames.number - frames.number[0] if (steps > 0).all() else np.arange(n)
    t = (frames.time_ns - frames.time_ns[0]) / quantum_ns
    line = np.polynomial.polynomial.polyfit(k, t, 1)
    off = t - line[0] - line[1] * k
    reach = float(off.max() - off.min())
    whole = abs(line[1] - round(line[1])) < 0.2 / n
    if 0.3 < reach < 1.2 and not whole:
        facts["cadence_s"] = float(line[1] * quantum_ns / SECOND_NS)
        return found._replace(verdict=WRONG, cause="times_cut", facts=facts)
    return found._replace(verdict=UNKNOWN, cause="whole_times")


def _is_comb(time_ns: Nanoseconds, quantum_ns: int) -> bool:
    rest = np.mod(time_ns + COMB_NS, quantum_ns)
    return bool((rest <= 2 * COMB_NS).all())


def check_coverage(
    frame_ns: Nanoseconds, state_ns: Nanoseconds, state_gap_s: float
) -> list[Finding]:
    """Return whether states cover the frames, and whether both have one time scale."""
    if not len(state_ns):
        return [Finding(COVERAGE, UNKNOWN, 0.0, expected=1.0, cause="no_states")]
    right = np.clip(np.searchsorted(state_ns, frame_ns), 0, len(state_ns) - 1)
    left = np.maximum(right - 1, 0)
    to_state = np.minimum(np.abs(state_ns[right] - frame_ns), np.abs(state_ns[left] - frame_ns))
    near = float((to_state <= state_gap_s * SECOND_NS).mean())
    lead_s = float(frame_ns[0] - state_ns[0]) / SECOND_NS
    trail_s = float(state_ns[-1] - frame_ns[-1]) / SECOND_NS
    step_s = float(np.median(np.diff(state_ns))) / SECOND_NS if len(state_ns) > 1 else 0.0
    # Times of frames minus those of states, if both were recorded from start to end.
    shift_s = (lead_s - trail_s) / 2
    facts = {"lead_s": lead_s, "trail_s": trail_s, "shift_s": shift_s}
    found = Finding(COVERAGE, SOUND, near, expected=1.0, facts=facts)
    offset_s = known_offset(shift_s)
    margin_s = (lead_s + trail_s) / 2
    uncovered_s = -min(lead_s, trail_s)
    if (
        offset_s
        and len(state_ns) >= 5
        and -1.0 <= margin_s <= 5.0 + step_s
        and uncovered_s > max(3 * step_s, 5.0)
        and step_s < 5.0
    ):
        cause = "frames_and_states_shifted"
        facts = {**facts, "offset_s": offset_s}
        return [found._replace(verdict=WRONG, cause=cause, facts=facts)]
    if near == 0.0:
        return [found._replace(verdict=WRONG, cause="no_state_near")]
    if near < 0.9:
        return [found._replace(verdict=UNKNOWN, cause="few_states_near")]
    return [found]


def check_night(
    time_ns: Nanoseconds, start_ns: int, end_ns: int, longest_lost: float
) -> Finding | None:
    """Return whether a sensor has frames all night, between the first and the last of any sensor.

    A gap is a time of `GAP_FRAMES` frame intervals, and of at least `SHORTEST_GAP_S`; also one at
    an end of the night.

    Parameters
    ----------
    time_ns
        (n,) times of its frames, in order; None is returned without any.
    longest_lost
        Largest share of the night that gaps may take.
    """
    if not len(time_ns) or end_ns <= start_ns:
        return None
    ends = np.concatenate([[start_ns], time_ns, [end_ns]])
    steps = np.diff(ends)
    inner = steps[1:-1]
    usual = float(np.median(inner)) if len(inner) else 0.0
    gaps = np.where(steps > max(GAP_FRAMES * usual, SHORTEST_GAP_S * SECOND_NS), steps, 0)
    lost, length = float(gaps.sum()), float(end_ns - start_ns)
    found = Finding(FRAMES_ALL_NIGHT, SOUND, lost / length, expected=0.0)
    if lost <= longest_lost * length:
        return found
    longest = int(np.argmax(gaps))
    facts = {
        "lost_s": lost / SECOND_NS, "length_s": length / SECOND_NS,
        "from_s": float(ends[longest] // SECOND_NS), "to_s": float(ends[longest + 1] // SECOND_NS),
    }  # fmt: skip
    return found._replace(verdict=WRONG, cause="long_gaps", facts=facts)


def known_offset(shift_s: float) -> float:
    """Return the offset between time scales that a shift is near to; 0 where there is none."""
    size = abs(shift_s)
    # GPS and TAI minus GPS are a second apart: the shift decides as far as it can.
    nearest = min((GPS_S, TAI_GPS_S, TAI_S), key=lambda known: abs(size - known))
    if abs(size - nearest) <= NEAR_OFFSET_S:
        return float(np.copysign(nearest, shift_s))
    hours = round(size / HOUR_S)
    if 1 <= hours <= 24 and abs(size - hours * HOUR_S) <= NEAR_OFFSET_S:
        return float(np.copysign(hours * HOUR_S, shift_s))
    return 0.0


def check_numbers(frames: LogFrames, camera: LogCamera | None) -> list[Finding]:
    """Return whether frames of two sensors have one id: numbers, or calibrations, alternate; and
    whether numbers do not count."""
    if camera is not None and camera.others:
        return [Finding(ONE_SENSOR, WRONG, camera.others, expected=0.0, cause="two_calibrations")]
    if len(frames.all_numbers) < MIN_FRAMES:
        return []
    steps = np.diff(frames.all_numbers)
    # A counter of two sensors goes back at every second frame, and forth; one that starts again,
    # seldom; one that counts down, never forth.
    back, same = float((steps < 0).mean()), float((steps == 0).mean())
    facts = {"count": int((steps == 0).sum()), "frames": len(steps) + 1}
    if same >= MIN_BACKWARD:
        return [Finding(ONE_SENSOR, WRONG, same, expected=0.0, cause="numbers_stay", facts=facts)]
    if back < MIN_BACKWARD or not (steps > 0).any():
        return []
    return [Finding(ONE_SENSOR, WRONG, back, expected=0.0, cause="numbers_alternate", facts=facts)]


def check_exposures(frames: LogFrames) -> list[Finding]:
    """Return whether exposures end before the next frame; none where they are unknown."""
    known = frames.exposure_s[frames.exposure_s > 0]
    if not len(known) or len(frames.time_ns) < MIN_FRAMES:
        return []
    exposure_s = float(np.median(known))
    interval_s = float(np.median(np.diff(frames.time_ns))) / SECOND_NS
    facts = {"exposure_s": exposure_s, "interval_s": interval_s}
    found = Finding(EXPOSURE_TIME, SOUND, exposure_s / interval_s, facts=facts)
    if exposure_s > LONGEST_EXPOSURE * interval_s:
        return [found._replace(verdict=WRONG, cause="exposure_too_long")]
    return [found]


def check_stated_sigma(sigma_px: Array) -> Finding:
    """Return whether the stated errors of centroids are possible; only stars show the true ones."""
    if not len(sigma_px):
        return Finding(CENTROID_SIGMA, UNKNOWN, unit="px", cause="no_centroid_sigma")
    found = Finding(CENTROID_SIGMA, UNKNOWN, float(np.median(sigma_px)), unit="px")
    if found.value < LEAST_SIGMA_PX:
        return found._replace(verdict=WRONG, cause="impossible_centroid_sigma")
    return found._replace(cause="centroid_sigma_uncompared")


def check_star_scatter(
    dx_px: Array, dy_px: Array, sigma_px: Array, n_frames: int
) -> Finding | None:
    """Return whether stated errors are those that stars show; None for too few stars.

    Parameters
    ----------
    dx_px, dy_px, sigma_px
        (n,) residuals of stars and their stated errors.
    n_frames
        Frames of which the attitude was fitted to these stars.
    """
    dof = 2 * len(dx_px) - 3 * n_frames
    if dof < MIN_SCATTER_DOF:
        return None
    scatter_px = float(np.sqrt((dx_px @ dx_px + dy_px @ dy_px) / dof))
    stated_px = float(np.sqrt(np.mean(sigma_px**2)))
    found = Finding(CENTROID_SIGMA, SOUND, scatter_px, expected=stated_px, unit="px")
    if scatter_px > SIGMA_RATIO * stated_px:
        return found._replace(verdict=WRONG, cause="centroid_sigma_too_small")
    if stated_px > SIGMA_RATIO * scatter_px:
        return found._replace(verdict=WRONG, cause="centroid_sigma_too_large")
    return found


def check_principal_point(camera: LogCamera) -> Finding:
    """Return whether the principal point is in the image, and not left at zero."""
    middle = np.array([camera.width - 1, camera.height - 1]) / 2
    off_px = float(np.hypot(*(np.array([camera.cx_px, camera.cy_px]) - middle)))
    facts = {"cx_px": camera.cx_px, "cy_px": camera.cy_px,
             "width": camera.width, "height": camera.height}  # fmt: skip
    found = Finding(PRINCIPAL_POINT, SOUND, off_px, expected=0.0, unit="px", facts=facts)
    at_corner = abs(camera.cx_px) <= 1.0 and abs(camera.cy_px) <= 1.0
    if at_corner and min(camera.width, camera.height) > 16:
        return found._replace(verdict=WRONG, cause="principal_point_zero")
    if not (0 <= camera.cx_px < camera.width and 0 <= camera.cy_px < camera.height):
        return found._replace(verdict=UNKNOWN, cause="principal_point_outside")
    return found


def check_image_size(frames: LogFrames, camera: LogCamera) -> Finding:
    """Return whether centroids fill the image that the calibration states."""
    x, y = frames.x_px, frames.y_px
    if len(x) < MIN_FLUXES:
        return Finding(IMAGE_SIZE, UNKNOWN, cause="few_centroids")
    outside = float(((x > camera.width) | (y > camera.height) | (x < -1) | (y < -1)).mean())
    reach_x, reach_y = float(np.quantile(x, 0.99)), float(np.quantile(y, 0.99))
    facts = {"x_px": reach_x, "y_px": reach_y, "width": camera.width, "height": camera.height}
    found = Finding(IMAGE_SIZE, SOUND, outside, expected=0.0, facts=facts)
    if outside > OUTSIDE:
        exchanged = float(((x > camera.height) | (y > camera.width)).mean()) <= OUTSIDE / 4
        cause = "width_and_height_exchanged" if exchanged else "image_too_small"
        return found._replace(verdict=WRONG, cause=cause)
    if reach_x < REACH * camera.width and reach_y < REACH * camera.height:
        return found._replace(verdict=UNKNOWN, cause="image_not_filled")
    return found


def check_flux(flux: Array) -> Finding:
    """Return whether fluxes are linear: magnitudes lie near their largest value, fluxes do not."""
    known = flux[np.isfinite(flux)]
    if len(known) < MIN_FLUXES:
        return Finding(FLUX, UNKNOWN, cause="no_flux" if not len(known) else "few_centroids")
    low, middle, high = np.quantile(known, [0.01, 0.5, 0.99])
    share = float((middle - low) / (high - low)) if high > low else 0.0
    found = Finding(FLUX, SOUND, share, expected=0.0, facts={"low": low, "high": high})
    if MAGNITUDES[0] < low and high < MAGNITUDES[1] and high - low < 14 and share > MAGNITUDE_SHARE:
        return found._replace(verdict=WRONG, cause="flux_is_magnitude")
    return found

"""The order of frames and states, and which are duplicates."""

import numpy as np
import numpy.typing as npt

Integers = npt.NDArray[np.int64]

KEEP, DUPLICATE_FRAME, DUPLICATE_NUMBER, DUPLICATE_TIME = range(4)


def order_frames(
    sensor: Integers, time_ns: Integers, frame_number: Integers
) -> tuple[Integers, npt.NDArray[np.int8]]:
    """Return the order of frames by sensor, time and number, and a verdict on each.

    Parameters
    ----------
    sensor, time_ns, frame_number : (n,) int
        The sensor as an index. Of equal frames the first is kept.

    Returns
    -------
    order : (n,) int
        Indices that sort the frames.
    verdict : (n,) int8
        In that order. KEEP: the frame is kept. DUPLICATE_FRAME: same sensor, number and time as
        a kept frame. DUPLICATE_NUMBER: same number as an earlier kept frame, at another time (a
        counter that restarted, or two sensors with one id). DUPLICATE_TIME: same time as a kept
        frame with a lower number: a sensor makes one exposure at a time.
    """
    order = np.lexsort((np.arange(len(sensor)), frame_number, time_ns, sensor))
    s, t, f = sensor[order], time_ns[order], frame_number[order]
    verdict = np.zeros(len(order), np.int8)
    if len(order) == 0:
        return order, verdict
    same_time = (s[1:] == s[:-1]) & (t[1:] == t[:-1])
    same_frame = same_time & (f[1:] == f[:-1])
    verdict[1:][same_time] = DUPLICATE_TIME
    verdict[1:][same_frame] = DUPLICATE_FRAME
    # By number, in order of time: all but the first repeat the number.
    rest = np.flatnonzero(verdict == KEEP)
    by_number = rest[np.lexsort((rest, f[rest], s[rest]))]
    a, b = by_number[:-1], by_number[1:]
    verdict[b[(s[a] == s[b]) & (f[a] == f[b])]] = DUPLICATE_NUMBER
    # A copy of a frame that is not kept has the verdict of that frame.
    copied = np.maximum.accumulate(np.where(verdict == DUPLICATE_FRAME, 0, np.arange(len(s))))
    copies = verdict == DUPLICATE_FRAME
    verdict[copies] = np.where(verdict[copied] == KEEP, DUPLICATE_FRAME, verdict[copied])[copies]
    return order, verdict


def order_states(sensor: Integers, time_ns: Integers) -> tuple[Integers, npt.NDArray[np.bool_]]:
    """Return the order of states by sensor and time, and which of them repeat their predecessor.

    A state repeats if sensor and time are the same; the first given is kept.
    """
    order = np.lexsort((np.arange(len(sensor)), time_ns, sensor))
    s, t = sensor[order], time_ns[order]
    repeats = np.zeros(len(order), bool)
    repeats[1:] = (s[1:] == s[:-1]) & (t[1:] == t[:-1])
    return order, repeats

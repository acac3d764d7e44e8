"""Independent epochs: positions of an object that share no detection."""

from epipole.tasks.algorithms.kernels import kernel


@kernel
def keep_independent(offsets, used, track, first_ns, last_ns, until, apart):
    """Clear `apart` where a group shares a detection with an earlier one that is kept.

    Parameters
    ----------
    offsets : (g + 1,) int
        Group k, one object at one epoch, has the views ``offsets[k]:offsets[k + 1]``; in order of
        time.
    used : (n,) bool
        The view counts.
    track : (n,) int
        Its tracklet, from 0 on.
    first_ns, last_ns : (n,) int
        The first and the last detection that its direction was fitted to.
    until : (tracklets,) int, out
        Starts below all times: then the last detection of each tracklet that a kept group uses.
    apart : (g,) bool, in and out
        The groups that may be kept; then those that are.
    """
    for g in range(len(apart)):
        for v in range(offsets[g], offsets[g + 1]):
            if used[v] and not first_ns[v] > until[track[v]]:
                apart[g] = False
        if apart[g]:
            for v in range(offsets[g], offsets[g + 1]):
                if used[v]:
                    until[track[v]] = last_ns[v]

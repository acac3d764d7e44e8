"""What services that screen ephemerides against each other ask of an OEM, as a checker.

Starlink's (docs.space-safety.starlink.com, Trajectories, read 2026-11-26): states in EME2000 or
ITRF, UTC, six at least and 21 days at most, 26,214,400 characters; a covariance at each state, in
RTN or a frame of states, none zero.
"""

import tempfile
from pathlib import Path

import numpy as np

MIN_STATES, MAX_DAYS, MAX_CHARACTERS = 6, 21.0, 26_214_400
STATE_FRAMES = {"EME2000", "ITRF"}
COVARIANCE_FRAMES = {"RTN", *STATE_FRAMES}
LONGEST_STEP_S = 180.0  # between states: all examples have a minute; ours are 120 s at most


def faults_of(text: str) -> list[str]:
    """Return what such a service would refuse in an OEM, as the library `oem` reads it."""
    from oem import OrbitEphemerisMessage

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.oem"
        path.write_text(text, encoding="ascii")
        segments = list(OrbitEphemerisMessage.open(str(path)))
    found = [] if len(text) <= MAX_CHARACTERS else ["more characters than are taken"]
    if len(segments) != 1:
        found.append("not one segment")
    for segment in segments:
        states, covariances = list(segment.states), list(segment.covariances)
        found += _of_states(segment.metadata, states) + _of_covariances(states, covariances)
    return found


def _of_states(metadata, states):
    at_s = np.array([(state.epoch - states[0].epoch).sec for state in states])
    wrong = {
        "frame": metadata["REF_FRAME"] not in STATE_FRAMES,
        "time system": metadata["TIME_SYSTEM"] != "UTC",
        "centre": metadata["CENTER_NAME"] != "EARTH",
        "few states": len(states) < MIN_STATES,
        "too long": at_s[-1] > MAX_DAYS * 86400,
        "order": bool((np.diff(at_s) <= 0).any()),
        "gap": bool((np.diff(at_s) > LONGEST_STEP_S).any()),
    }
    return [name for name, is_wrong in wrong.items() if is_wrong]


def _of_covariances(states, covariances):
    if [c.epoch.isot for c in covariances] != [s.epoch.isot for s in states]:
        return ["a state without covariance"]
    least = min(np.linalg.eigvalsh(c.matrix / _scale(c.matrix)).min() for c in covariances)
    found = ["covariance zero"] if least <= 0 else []
    frames = {c.frame for c in covariances}
    return found + (["frame of covariance"] if frames - COVARIANCE_FRAMES else [])


def _scale(matrix):
    sigma = np.sqrt(np.diag(matrix))
    return np.outer(sigma, sigma)

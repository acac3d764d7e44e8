"""Ephemerides of one object: each of its states, moved through the arc that it was fitted to."""

import numpy as np
import polars as pl

from epipole.io.ccsds.orbit_data import Ephemeris
from epipole.schemas.bridge import stack_covariance
from epipole.schemas.columns import PLACE, STATE_AXES, VELOCITY
from epipole.tasks.algorithms.orbits.orbit_fit import trajectory

HALF_ARC_S = 300.0  # a state is of an arc of ten minutes at most
STEPS = 60  # of an arc, at least
SECOND_NS = 1_000_000_000


def single_states(states: pl.DataFrame) -> list[Ephemeris]:
    """Return each of the STATES of one object by itself."""
    time_ns = states["epoch"].dt.epoch("ns").to_numpy()
    state = states.select(*PLACE, *VELOCITY).to_numpy()
    covariance = stack_covariance(states.to_arrow(), "cov_{}", STATE_AXES)
    return [
        Ephemeris(time_ns[k : k + 1], state[k : k + 1], time_ns[k : k + 1], covariance[k : k + 1])
        for k in range(len(time_ns))
    ]


def arcs(states: pl.DataFrame, positions: pl.DataFrame) -> list[Ephemeris]:
    """Return an ephemeris for each of the STATES of one object, in order of time.

    It covers the object's POSITIONS about the state's epoch: point mass and J2 from there, and the
    covariance at the epoch and at both ends.
    """
    seen_ns = positions["epoch"].dt.epoch("ns").to_numpy()
    return [_arc(state, seen_ns) for state in single_states(states.sort("epoch"))]


def _arc(of: Ephemeris, seen_ns: np.ndarray) -> Ephemeris:
    epoch_ns = int(of.time_ns[0])
    since_s = (seen_ns - epoch_ns) / SECOND_NS
    own = since_s[np.abs(since_s) <= HALF_ARC_S]
    first, last = min(own.min(initial=0.0), -1.0), max(own.max(initial=0.0), 1.0)
    step = (last - first) / STEPS
    later = np.linspace(0.0, last, int(np.ceil(last / step)) + 1)
    earlier = np.linspace(0.0, first, int(np.ceil(-first / step)) + 1)
    at_s = np.concatenate([later, earlier[1:]])  # outwards from the epoch: the fastest order
    state, transition = trajectory(of.state[0], at_s)
    order = np.argsort(at_s, kind="stable")
    time_ns = epoch_ns + np.rint(at_s * SECOND_NS).astype(np.int64)
    told = order[[0, int(np.flatnonzero(order == 0)[0]), -1]]
    covariance = transition[told] @ of.covariance[0] @ np.swapaxes(transition[told], 1, 2)
    return Ephemeris(time_ns[order], state[order], time_ns[told], covariance)

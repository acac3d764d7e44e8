"""Orbit data messages (CCSDS 502.0-B-3): ephemerides (OEM) and single states (OPM), in GCRF."""

from collections.abc import Sequence
from typing import NamedTuple

import ccsds_ndm as ccsds
import numpy as np
import numpy.typing as npt

from epipole.io.ccsds.text import ORIGINATOR, now, safe_name, times

Array = npt.NDArray[np.float64]

_AXES = ("x", "y", "z", "x_dot", "y_dot", "z_dot")
DEGREE = 7  # of the Hermite interpolation, where there are so many states


class Ephemeris(NamedTuple):
    """States of one object or sensor, sorted by time.

    time_ns : (n,) int, UTC
    state : (n, 6) float
        Position [km] and velocity [km/s], GCRF.
    covariance_ns : (m,) int
        Times of the covariances, UTC.
    covariance : (m, 6, 6) float
    """

    time_ns: npt.NDArray[np.int64]
    state: Array
    covariance_ns: npt.NDArray[np.int64]
    covariance: Array


def ephemeris_message(name: str, parts: Sequence[Ephemeris], comments: Sequence[str]) -> str:
    """Return the OEM of one object, with a segment per part."""
    segments = [_segment(name, part, comments) for part in parts]
    return str(ccsds.Oem(_header(), segments).to_str("kvn"))


def _segment(name: str, part: Ephemeris, comments: Sequence[str]) -> ccsds.OemSegment:
    at = times(part.time_ns)
    known = safe_name(name)
    metadata = ccsds.OemMetadata(
        known,
        known,
        at[0],
        at[-1],
        center_name="EARTH",
        ref_frame="GCRF",
        time_system="UTC",
        interpolation="HERMITE",
        interpolation_degree=int(min(DEGREE, max(len(at) - 1, 1))),
        comment=list(comments),
    )
    states = [
        ccsds.StateVectorAcc(epoch, *values)
        for epoch, values in zip(at, np.round(part.state, 9).tolist(), strict=True)
    ]
    lower = np.tril_indices(6)
    covariances = [
        ccsds.OemCovarianceMatrix(epoch, matrix[lower], None, [])
        for epoch, matrix in zip(times(part.covariance_ns), part.covariance, strict=True)
    ]
    return ccsds.OemSegment(metadata, ccsds.OemData(states, covariances))


def state_message(name: str, part: Ephemeris, comments: Sequence[str]) -> str:
    """Return the OPM of one state, with its covariance."""
    known = safe_name(name)
    metadata = ccsds.OpmMetadata(
        known, known, center_name="EARTH", ref_frame="GCRF", time_system="UTC",
        comment=list(comments),
    )  # fmt: skip
    (epoch,) = times(part.time_ns)
    data = ccsds.OpmData(ccsds.StateVector(epoch, *np.round(part.state[0], 9).tolist()))
    data.covariance_matrix = ccsds.OpmCovarianceMatrix(
        **{
            f"c{_AXES[i]}_{_AXES[j]}": float(part.covariance[0][i, j])
            for i, j in zip(*np.tril_indices(6), strict=True)
        }
    )
    return str(ccsds.Opm(_header(), ccsds.OpmSegment(metadata, data)).to_str("kvn"))


def _header() -> ccsds.OdmHeader:
    return ccsds.OdmHeader(now(), ORIGINATOR)

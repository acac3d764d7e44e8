"""CCSDS messages for orbit determination: OEM, OPM and OCM (502.0-B-3), TDM (503.0-B-2).

As keywords with values (`form` kvn), or in XML (505.0-B-3).
"""

import datetime
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import ccsds_ndm as ccsds
import numpy as np

from epipole.schemas.arrays import Array, Integers
from epipole.schemas.errors import DatasetError
from epipole.schemas.text import LONGEST_LINE, as_line

# Times, names and headers of all messages.

ORIGINATOR = "EPIPOLE"
_UNSAFE = re.compile(r"[^A-Za-z0-9._+-]")
# Lines of messages have 254 characters at most (CCSDS 502.0-B-3, 7.3.3), and names of files 255.
LONGEST_NAME, LONGEST_COMMENT = 200, 240


def times(time_ns: Integers) -> list[str]:
    """Return UTC times to the microsecond: more digits break readers."""
    rounded = ((time_ns + 500) // 1000).astype("datetime64[us]")
    return [str(t) for t in np.datetime_as_string(rounded, unit="us")]


def now() -> str:
    """Return the time of creation, UTC."""
    return f"{datetime.datetime.now(datetime.UTC):%Y-%m-%dT%H:%M:%S}"


def safe_name(text: str) -> str:
    """Return a name for a message or a file: letters, digits and ``._+-``, the rest as ``_``.

    A longer one than a line has room for is cut.
    """
    return _UNSAFE.sub("_", text[:LONGEST_NAME]) or "_"


def as_ascii(text: str, longest: int = LONGEST_LINE) -> str:
    """Return a text as one line of ASCII, cut to `longest`."""
    return as_line(text, longest).encode("ascii", "replace").decode()


def write_message(path: Path, text: str) -> None:
    """Write a message.

    Raises
    ------
    DatasetError
        Where the file cannot be written.
    """
    try:
        path.write_text(text, encoding="ascii")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be written ({error.strerror})") from error


# Ephemerides (OEM, OCM) and single states (OPM).


_AXES = ("x", "y", "z", "x_dot", "y_dot", "z_dot")
DEGREE = 7  # of the Hermite interpolation, if there are enough states


class Subject(NamedTuple):
    """What a message is of: an object, a tracklet or a sensor, with its name in a catalogue."""

    subject_id: str
    norad_id: int | None = None
    cospar_id: str | None = None
    name: str | None = None

    @property
    def message_name(self) -> str:
        """The name in a catalogue, else the id."""
        return safe_name(self.name or self.subject_id)

    @property
    def message_id(self) -> str:
        """The international designator, else the id."""
        return safe_name(self.cospar_id or self.subject_id)

    def comments(self) -> list[str]:
        """Return a comment with the id and the numbers in a catalogue; none without these."""
        numbers = {"NORAD": self.norad_id, "COSPAR": self.cospar_id, "NAME": self.name}
        known = [f"{what} {value}" for what, value in numbers.items() if value is not None]
        says = f"ID {self.subject_id}, {', '.join(known)}"
        return [as_ascii(says, LONGEST_COMMENT)] if known else []


class Ephemeris(NamedTuple):
    """States of one object or sensor, sorted by time.

    time_ns : (n,) int, UTC
    state : (n, 6) float
        Position [km] and velocity [km/s].
    covariance_ns : (m,) int
        Times of the covariances, UTC.
    covariance : (m, 6, 6) float
    frame
        Of states and covariances.
    """

    time_ns: Integers
    state: Array
    covariance_ns: Integers
    covariance: Array
    frame: str = "GCRF"


def ephemeris_message(
    of: Subject, parts: Sequence[Ephemeris], comments: Sequence[str], form: str = "kvn"
) -> str:
    """Return the OEM of one object or sensor, with a segment per part."""
    segments = [_ephemeris_segment(of, part, comments) for part in parts]
    return str(ccsds.Oem(_header(), segments).to_str(form))


def _ephemeris_segment(of: Subject, part: Ephemeris, comments: Sequence[str]) -> ccsds.OemSegment:
    at = times(part.time_ns)
    metadata = ccsds.OemMetadata(
        of.message_name,
        of.message_id,
        at[0],
        at[-1],
        center_name="EARTH",
        ref_frame=part.frame,
        time_system="UTC",
        interpolation="HERMITE",
        interpolation_degree=int(min(DEGREE, max(len(at) - 1, 1))),
        comment=[*of.comments(), *comments],
    )
    states = [
        ccsds.StateVectorAcc(epoch, *values)
        for epoch, values in zip(at, np.round(part.state, 9).tolist(), strict=True)
    ]
    lower = np.tril_indices(6)
    covariances = [
        ccsds.OemCovarianceMatrix(epoch, matrix[lower], part.frame, [])
        for epoch, matrix in zip(times(part.covariance_ns), part.covariance, strict=True)
    ]
    return ccsds.OemSegment(metadata, ccsds.OemData(states, covariances))


def state_message(of: Subject, part: Ephemeris, comments: Sequence[str], form: str = "kvn") -> str:
    """Return the OPM of one state, with its covariance."""
    metadata = ccsds.OpmMetadata(
        of.message_name, of.message_id, center_name="EARTH", ref_frame=part.frame,
        time_system="UTC", comment=[*of.comments(), *comments],
    )  # fmt: skip
    (epoch,) = times(part.time_ns)
    data = ccsds.OpmData(ccsds.StateVector(epoch, *np.round(part.state[0], 9).tolist()))
    data.covariance_matrix = ccsds.OpmCovarianceMatrix(
        **{
            f"c{_AXES[i]}_{_AXES[j]}": float(part.covariance[0][i, j])
            for i, j in zip(*np.tril_indices(6), strict=True)
        }
    )
    return str(ccsds.Opm(_header(), ccsds.OpmSegment(metadata, data)).to_str(form))


def comprehensive_message(
    of: Subject, part: Ephemeris, comments: Sequence[str], form: str = "kvn"
) -> str:
    """Return the OCM of one object: its ephemeris, with the covariance of each state."""
    at = times(part.time_ns)
    metadata = ccsds.OcmMetadata(
        time_system="UTC", epoch_tzero=at[0], object_name=of.message_name,
        international_designator=None if of.cospar_id is None else safe_name(of.cospar_id),
        catalog_name=None if of.norad_id is None else "SATCAT",
        object_designator=safe_name(of.subject_id) if of.norad_id is None else f"{of.norad_id}",
        start_time=at[0], stop_time=at[-1], comment=[*of.comments(), *comments],
    )  # fmt: skip
    lines = zip(at, np.round(part.state, 9).tolist(), strict=True)
    trajectory = ccsds.OcmTrajState(
        center_name="EARTH", traj_ref_frame=part.frame, traj_type="CARTPV",
        traj_basis="DETERMINED", interpolation="HERMITE",
        interpolation_degree=int(min(DEGREE, max(len(at) - 1, 1))),
        traj_lines=[ccsds.TrajLine(epoch=epoch, values=values) for epoch, values in lines],
    )  # fmt: skip
    lower = np.tril_indices(6)
    matrices = zip(times(part.covariance_ns), part.covariance, strict=True)
    covariance = ccsds.OcmCovarianceMatrix(
        cov_ref_frame=part.frame, cov_type="CARTPV", cov_ordering="LTM", cov_basis="DETERMINED",
        cov_lines=[ccsds.CovLine(epoch=e, values=matrix[lower].tolist()) for e, matrix in matrices],
    )  # fmt: skip
    data = ccsds.OcmData()
    data.traj, data.cov = [trajectory], [covariance]
    return str(ccsds.Ocm(_header(), ccsds.OcmSegment(metadata, data)).to_str(form))


def _header() -> ccsds.OdmHeader:
    return ccsds.OdmHeader(now(), ORIGINATOR)


# Tracking data (TDM): directions, a segment per sensor and object or tracklet.


class Directions(NamedTuple):
    """One sensor's directions of an object, sorted by time.

    time_ns : (n,) int, UTC
    ra_deg, dec_deg : (n,) float
        Astrometric, in the axes of EME2000: TDM names no GCRF, and readers need data for ICRF.
    magnitude : (n,) float, NaN where unknown
    aberration_deg : float
        Mean angle of the aberration that was removed.
    ephemeris : str
        Name of the file with the sensor's ephemeris.
    comments : sequence of str
    """

    time_ns: Integers
    ra_deg: Array
    dec_deg: Array
    magnitude: Array
    aberration_deg: float
    ephemeris: str
    comments: Sequence[str]


def tracking_data(seen: Iterable[tuple[Subject, str, Directions]], form: str = "kvn") -> str:
    """Return a message with a segment for each object or tracklet and its sensor."""
    segments = [_tracking_segment(*of) for of in seen]
    header = ccsds.TdmHeader(originator=ORIGINATOR, creation_date=now())
    message = ccsds.Tdm(header=header, body=ccsds.TdmBody(segments=segments))
    return str(message.to_str(form))


def _tracking_segment(of: Subject, sensor: str, seen: Directions) -> ccsds.TdmSegment:
    at = times(seen.time_ns)
    metadata = ccsds.TdmMetadata(
        time_system="UTC",
        start_time=at[0],
        stop_time=at[-1],
        participant_1=safe_name(sensor),
        participant_2=safe_name(of.subject_id),
        mode="SEQUENTIAL",
        path="2,1",
        ephemeris_name_1=seen.ephemeris,
        timetag_ref="RECEIVE",
        angle_type="RADEC",
        reference_frame="EME2000",
        correction_aberration_yearly=0.0,
        correction_aberration_diurnal=seen.aberration_deg,
        corrections_applied="YES",
        comment=[*of.comments(), *seen.comments],
    )
    rows = []
    columns = (at, seen.ra_deg.tolist(), seen.dec_deg.tolist(), seen.magnitude.tolist())
    for epoch, ra, dec, magnitude in zip(*columns, strict=True):
        rows.append(ccsds.TdmObservation(epoch=epoch, keyword="ANGLE_1", value=round(ra, 9)))
        rows.append(ccsds.TdmObservation(epoch=epoch, keyword="ANGLE_2", value=round(dec, 9)))
        if magnitude == magnitude:
            rows.append(ccsds.TdmObservation(epoch=epoch, keyword="MAG", value=round(magnitude, 3)))
    return ccsds.TdmSegment(metadata=metadata, data=ccsds.TdmData(observations=rows))

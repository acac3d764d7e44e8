"""Tracking data messages (CCSDS 503.0-B-2): the directions of one object, a segment per sensor."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import ccsds_ndm as ccsds
import numpy as np
import numpy.typing as npt

from epipole.io.ccsds.text import ORIGINATOR, now, safe_name, times

Array = npt.NDArray[np.float64]


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

    time_ns: npt.NDArray[np.int64]
    ra_deg: Array
    dec_deg: Array
    magnitude: Array
    aberration_deg: float
    ephemeris: str
    comments: Sequence[str]


def tracking_data(object_id: str, of_sensors: Mapping[str, Directions]) -> str:
    """Return the message of one object, with a segment per sensor."""
    segments = [_segment(object_id, sensor, seen) for sensor, seen in of_sensors.items()]
    header = ccsds.TdmHeader(originator=ORIGINATOR, creation_date=now())
    message = ccsds.Tdm(header=header, body=ccsds.TdmBody(segments=segments))
    return str(message.to_str("kvn"))


def _segment(object_id: str, sensor: str, seen: Directions) -> ccsds.TdmSegment:
    at = times(seen.time_ns)
    metadata = ccsds.TdmMetadata(
        time_system="UTC",
        start_time=at[0],
        stop_time=at[-1],
        participant_1=safe_name(sensor),
        participant_2=safe_name(object_id),
        mode="SEQUENTIAL",
        path="2,1",
        ephemeris_name_1=seen.ephemeris,
        timetag_ref="RECEIVE",
        angle_type="RADEC",
        reference_frame="EME2000",
        correction_aberration_yearly=0.0,
        correction_aberration_diurnal=seen.aberration_deg,
        corrections_applied="YES",
        comment=list(seen.comments),
    )
    rows = []
    columns = (at, seen.ra_deg.tolist(), seen.dec_deg.tolist(), seen.magnitude.tolist())
    for epoch, ra, dec, magnitude in zip(*columns, strict=True):
        rows.append(ccsds.TdmObservation(epoch=epoch, keyword="ANGLE_1", value=round(ra, 9)))
        rows.append(ccsds.TdmObservation(epoch=epoch, keyword="ANGLE_2", value=round(dec, 9)))
        if magnitude == magnitude:
            rows.append(ccsds.TdmObservation(epoch=epoch, keyword="MAG", value=round(magnitude, 3)))
    return ccsds.TdmSegment(metadata=metadata, data=ccsds.TdmData(observations=rows))

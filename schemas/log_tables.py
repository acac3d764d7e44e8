"""What one log gives, before its states are turned to GCRF and logs are put together."""

from typing import NamedTuple

import pyarrow as pa

from epipole.schemas.columns import axes, column, id_column, schema, time_column
from epipole.schemas.work_tables import SENSOR_STATES

GCRF, EME2000, TEME, ITRF = "GCRF", "EME2000", "TEME", "ITRF"
STATE_FRAMES = (GCRF, EME2000, TEME, ITRF)

LOG_STATES = schema(
    "log_states",
    "One row a state as the log has it, in the log's own frame.",
    [
        id_column("sensor_id", doc="Star sensor."),
        time_column(doc="Time of the state, UTC."),
        column("frame", pa.string(), doc="GCRF, EME2000, TEME or ITRF."),
        *axes("{}_km", unit="km", frame="frame", doc="Sensor position"),
        *axes("v{}_km_s", unit="km/s", frame="frame", null=True, doc="Velocity; null: not sent"),
        *[
            SENSOR_STATES.field(name)
            for name in ("position_sigma_km", "qx", "qy", "qz", "qw", "attitude_sigma_arcsec")
        ],
    ],
)


class LogSource(NamedTuple):
    """A log that was read: a row of `sources` without what publishing adds."""

    name: str
    size: int  # bytes
    sha256: str
    first_time_ns: int  # of its frames
    last_time_ns: int


class LogPiece(NamedTuple):
    """What a stretch of one log holds."""

    exposures: pa.Table  # EXPOSURES, in the order of the log
    states: pa.Table  # LOG_STATES
    cameras: pa.Table  # CAMERAS
    rejects: pa.Table  # REJECTS; all with the last piece
    source: LogSource | None  # with the last piece


class LogPart(NamedTuple):
    """What one log holds."""

    exposures: pa.Table  # EXPOSURES, in the order of the log
    states: pa.Table  # LOG_STATES
    cameras: pa.Table  # CAMERAS
    rejects: pa.Table  # REJECTS
    source: LogSource

"""The content of one log, before its states are converted to GCRF."""

from typing import NamedTuple

import pyarrow as pa

from epipole.schemas.columns import axes, column, id_column, schema, time_column
from epipole.schemas.work_tables import SENSOR_STATES

GCRF, EME2000, TEME, ITRF = "GCRF", "EME2000", "TEME", "ITRF"
STATE_FRAMES = (GCRF, EME2000, TEME, ITRF)

LOG_STATES = schema(
    "log_states",
    "One row per state, in the frame that the log uses.",
    [
        id_column("sensor_id", doc="Star sensor."),
        time_column(doc="Time of the state, UTC."),
        column("frame", pa.string(), doc="GCRF, EME2000, TEME or ITRF."),
        *axes("{}_km", unit="km", frame="frame", doc="Sensor position"),
        *axes(
            "v{}_km_s",
            unit="km/s",
            frame="frame",
            null=True,
            doc="Velocity; null where the log has none",
        ),
        *[
            SENSOR_STATES.field(name)
            for name in ("position_sigma_km", "qx", "qy", "qz", "qw", "attitude_sigma_arcsec")
        ],
    ],
)


class LogSource(NamedTuple):
    """A log that was read: a row of `sources` without the columns that publishing adds."""

    name: str
    size: int  # bytes
    sha256: str
    first_time_ns: int | None  # of its frames, else of its states; None without both
    last_time_ns: int | None


class LogPiece(NamedTuple):
    """A piece of one log: what reading yields, so that a log need not fit into memory."""

    exposures: pa.Table  # EXPOSURES, in the order of the log
    states: pa.Table  # LOG_STATES
    cameras: pa.Table  # CAMERAS
    rejects: pa.Table  # REJECTS; empty but in the last piece
    source: LogSource | None  # None but in the last piece


class LogContents(NamedTuple):
    """All that one log holds."""

    exposures: pa.Table  # EXPOSURES, in the order of the log
    states: pa.Table  # LOG_STATES
    cameras: pa.Table  # CAMERAS
    rejects: pa.Table  # REJECTS
    source: LogSource

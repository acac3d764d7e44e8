"""Columns of an object of the night at a glance."""

import pyarrow as pa

from epipole.schemas.columns import column, id_column, time_column

OBJECT_FIELDS = [
    time_column("first_time", doc="Its first observation or position, UTC."),
    time_column("last_time", doc="Its last observation or position, UTC."),
    column("n_sensors", pa.int32(), doc="Sensors in its rows of `observations`."),
    column("n_tracklets", pa.int32(), doc="Tracklets in its rows of `observations`."),
    column("n_observations", pa.int32(), doc="Rows of `observations`."),
    column("n_positions", pa.int32(), doc="Rows of `positions`."),
    column("found", pa.string(), doc="How it was found: a `Found`."),
    column("verdict", pa.string(), doc="What is to be thought of it: an `ObjectVerdict`."),
    column(
        "magnitude",
        pa.float64(),
        unit="mag",
        null=True,
        doc="Mean V of its observations that are not blended; null where none has a magnitude.",
    ),
    column(
        "magnitude_amplitude",
        pa.float64(),
        unit="mag",
        null=True,
        doc="From minimum to maximum of the sine with the scatter that `magnitude_1000_km` has "
        "beyond its sigmas; 0 where these explain it. Null with fewer than two of them.",
    ),
    column("norad_id", pa.int64(), null=True, doc="As in `identifications`; null: it has no name."),
    id_column("cospar_id", null=True, doc="The same."),
    column("name", pa.string(), null=True, doc="The same, only where it is known."),
]

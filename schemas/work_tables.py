"""Tables that pass from task to task and are not published."""

from typing import NamedTuple

import pyarrow as pa

from epipole.schemas.attributable import ATTRIBUTABLE_FIELDS
from epipole.schemas.columns import (
    OPTICS_AXES,
    POSITION,
    TANGENT_AXES,
    axes,
    column,
    covariance,
    id_column,
    schema,
    time_column,
)
from epipole.schemas.observation import FITTED_FIELDS
from epipole.schemas.tables import (
    ASSOCIATIONS,
    EPOCH,
    EPOCHS,
    F64,
    FRAME_KEY,
    FRAMES,
    I64,
    OBJECT_ID,
    OBSERVATIONS,
    POSITIONS,
    SENSOR_ID,
    TRACKLET_FIELDS,
)

# From stage to stage.


def _floats() -> pa.DataType:
    # float32 as in the messages: float64 would double the memory of a night.
    return pa.list_(pa.field("element", pa.float32(), nullable=False))


EXPOSURES = schema(
    "exposures",
    "One row per frame of the log. The arrays of a row have equal length.",
    [
        *FRAME_KEY,
        column("exposure_s", F64, unit="s", doc="Exposure time."),
        column("x_px", _floats(), unit="px", frame="image", doc="Column of each centroid."),
        column("y_px", _floats(), unit="px", frame="image", doc="Row of each centroid."),
        column("flux", _floats(), null=True, doc="Linear, any unit; null where unknown."),
        column("sigma_px", _floats(), unit="px", null=True, doc="1-sigma; null where unknown."),
        column("source", pa.string(), doc="Log file."),
        column("offset", I64, null=True, unit="byte", doc="Offset in the log."),
    ],
)

SENSOR_STATES = schema(
    "sensor_states",
    "One row per state of the log, converted to GCRF.",
    [
        SENSOR_ID,
        time_column(doc="Time of the state, UTC."),
        *axes("{}_km", unit="km", frame="GCRF", doc="Sensor position"),
        *axes(
            "v{}_km_s",
            unit="km/s",
            frame="GCRF",
            null=True,
            doc="Velocity; null where the log has none",
        ),
        column("position_sigma_km", F64, unit="km", doc="1-sigma per axis; 0 where unknown."),
        *[
            column(f"q{a}", F64, null=True, frame="sensor from ICRS", doc="Prior attitude.")
            for a in "xyzw"
        ],
        column("attitude_sigma_arcsec", F64, unit="arcsec", doc="1-sigma; 0 where unknown."),
    ],
)

CAMERAS = schema(
    "cameras",
    "One row per calibration of the log, or of the fit to its stars where the log's is wrong.",
    [
        SENSOR_ID,
        time_column(doc="Start of its validity, UTC. The first also holds before."),
        column("width", I64, unit="px", doc="Image width."),
        column("height", I64, unit="px", doc="Image height."),
        *[
            column(name, F64, doc="Pinhole and Brown-Conrady coefficients.")
            for name in ("fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3", "k4")
        ],
        column("fisheye", pa.bool_(), doc="A fisheye instead of a pinhole."),
        column(
            "line_time_s", F64, unit="s", doc="Rolling shutter: from a row to the next; 0: none."
        ),
        *covariance(
            "cov_{}",
            unit="products of the units of both numbers",
            doc="Covariance of the optics; 0 for those of the log.",
            names=OPTICS_AXES,
        ),
    ],
)

USED_SIGMA = column(
    "used_position_sigma_km",
    F64,
    unit="km",
    null=True,
    doc="1-sigma per axis; that of the settings where the log states none.",
)

SENSOR_STATES_AT_FRAMES = schema(
    "sensor_states_at_frames",
    "One row per frame, in the order of exposures: the state interpolated to the frame's time.",
    [
        *FRAME_KEY,
        *axes(
            "{}_km", unit="km", frame="GCRF", null=True, doc="Position; null where no state is near"
        ),
        *axes("v{}_km_s", unit="km/s", frame="GCRF", null=True, doc="Velocity"),
        column("position_sigma_km", F64, unit="km", null=True, doc="Stated 1-sigma per axis."),
        USED_SIGMA,
        *[
            column(
                f"q{a}",
                F64,
                null=True,
                frame="sensor from ICRS",
                doc="Prior attitude; null where there is none",
            )
            for a in "xyzw"
        ],
        column("attitude_sigma_arcsec", F64, unit="arcsec", null=True, doc="1-sigma of the prior."),
    ],
)

SOLUTIONS = schema(
    "solutions",
    "One row per frame: the columns of `frames`, and those that later stages need.",
    [
        *FRAMES,
        *covariance(
            "cov_att_{}_arcsec2",
            unit="arcsec^2",
            frame="sensor",
            null=True,
            doc="Covariance of the small rotation from the true to the reported sensor axes. If "
            "from stars: of what is independent in each frame; the sigmas include the optics.",
        ),
        USED_SIGMA,
        column("camera", I64, doc="Row of the sensor's `cameras` that is valid for the frame."),
        column(
            "zero_mag",
            F64,
            unit="mag",
            null=True,
            doc="Magnitude of a flux of 1; null where no identified star has a flux.",
        ),
        column("zero_variance_mag2", F64, unit="mag^2", null=True, doc="Its variance."),
        column(
            "flux_floor_mag2",
            F64,
            unit="mag^2",
            doc="Variance of the magnitude of one bright centroid.",
        ),
        column(
            "flux_photon_mag2", F64, unit="mag^2", doc="Divided by the flux, it adds to the floor."
        ),
    ],
)

SIGHTINGS = schema(
    "sightings",
    "One row per detection of a tracklet of one sensor: `observations` without what its object "
    "tells. A detection that belongs to no tracklet has the mark of `lone_detections`.",
    [
        field
        for field in OBSERVATIONS
        if field.name not in {"object_id", *(field.name for field in FITTED_FIELDS)}
    ],
)

FITTED_OBSERVATIONS = schema(
    "fitted_observations",
    "One row per row of `observations` that has an object: what its orbit, or its positions, tell.",
    [
        column("row", I64, doc="Row of the night's `observations`; they are in order."),
        *[field for field in FITTED_FIELDS if field.name != "magnitude_1000_km"],
    ],
)

_SHARE = column("share", I64, doc="Number of the share of objects; rows are sorted by it.")
_ROW = column("row", I64, doc="Row of the night's table.")
SHARED_OBSERVATIONS = schema(
    "shared_observations",
    "Rows of `observations` that have an object, by the share of objects they are in.",
    [
        _SHARE,
        _ROW,
        *[
            OBSERVATIONS.field(name)
            for name in (
                "time", "object_id", "tracklet_id", "sensor_id", "ra_deg", "dec_deg",
                "sigma_ra_arcsec", "sigma_dec_arcsec", "correlation", "bias_sigma_arcsec",
                *POSITION, "position_sigma_km",
            )
        ],
    ],
)  # fmt: skip
SHARED_POSITIONS = schema(
    "shared_positions",
    "Rows of `positions`, by the share of objects they are in.",
    [_SHARE, _ROW, *[POSITIONS.field(name) for name in ("epoch", "time", "object_id", *POSITION)]],
)

VIEWS = schema(
    "views",
    "One row per tracklet and epoch: the object's direction from the sensor.",
    [
        EPOCH,
        SENSOR_ID,
        column("frame_number", I64, doc="The nearest frame."),
        id_column("tracklet_id", doc="Tracklet whose motion gives the direction."),
        column("centroid", pa.int32(), null=True, doc="Centroid in that frame; null: a miss."),
        *axes("{}_px", unit="px", frame="image", doc="Pixel position at the epoch", names="xy"),
        *axes("u{}", unit="", frame="ICRS", doc="Direction, aberration removed"),
        *axes("w{}_rad_s", unit="rad/s", frame="ICRS", doc="Rate of the direction; 0: unknown"),
        *covariance(
            "cov_noise_{}_rad2",
            unit="rad^2",
            frame="tangent plane of the direction",
            doc="Error that is independent in each frame.",
            names=TANGENT_AXES,
        ),
        *covariance(
            "cov_bias_{}_rad2",
            unit="rad^2",
            frame="tangent plane of the direction",
            doc="Error that is common to all frames of the sensor.",
            names=TANGENT_AXES,
        ),
        column(
            "blend_rad2",
            F64,
            unit="rad^2",
            doc="Part of the noise: what the light of a neighbour may add, per axis.",
        ),
        column(
            "attitude_rad2",
            F64,
            unit="rad^2",
            doc="Part of the bias, per axis: a turn of all directions, as of a prior attitude.",
        ),
        column(
            "turn_noise_rad2",
            F64,
            unit="rad^2",
            doc="Part of the noise, per axis: a turn of all directions of the frame.",
        ),
        column("field_part", pa.int8(), doc="Ninth of the image that the pixel is in, by rows."),
        time_column("first_fitted", doc="First detection that the direction was fitted to, UTC."),
        time_column("last_fitted", doc="Last detection that the direction was fitted to, UTC."),
        column("moment_1", F64, unit="s", doc="Weighted mean of their times minus the epoch."),
        column("moment_2", F64, unit="s^2", doc="The same of the square of these times."),
        column("moment_3", F64, unit="s^3", doc="The same of the cube of these times."),
        column(
            "unmodelled_rad2",
            F64,
            unit="rad^2",
            doc="Part of the noise: what the fit neglects of the motion at these times, per axis.",
        ),
        *axes("{}_km", unit="km", frame="GCRF", doc="Sensor position at the epoch"),
        *axes("sensor_v{}_km_s", unit="km/s", frame="GCRF", null=True, doc="Velocity at the epoch"),
        column("position_sigma_km", F64, unit="km", doc="1-sigma per axis."),
        column("pixel_rad", F64, unit="rad", doc="Angle a pixel spans."),
        column(
            "magnitude",
            F64,
            unit="mag",
            null=True,
            doc="Mean of the detections that the direction was fitted to, without blended ones.",
        ),
    ],
)

FRAME_INDEX = schema(
    "frame_index",
    "One row per frame of one sensor, each once, in time order: where its exposure was read to.",
    [
        time_column(),
        column("log", pa.int32(), doc="Index of the log in the run, in the order of names."),
        column("piece", pa.int32(), doc="Index of the piece of the log."),
        column("row", I64, doc="Row in the exposures of the piece."),
        column(
            "shift", I64, doc="To add to the frame's number in its night: the counter restarted."
        ),
        column(
            "shift_beside", I64, doc="The same in the night beside, of which it is in the margin."
        ),
    ],
)

TRACKLET_NAMES = schema(
    "tracklet_names",
    "One row per tracklet of one sensor and span: its ids in the night.",
    [
        id_column("span_name", doc="Id in the span."),
        id_column("tracklet_id", doc="Id in the night."),
        id_column("track_id", doc="Track in the night that it was joined to."),
    ],
)

SENSOR_EPOCHS = schema(
    "sensor_epochs",
    "One row per epoch of one sensor: the columns of `epochs`, and the state of the frame.",
    [
        *EPOCHS,
        *[column(f"q{a}", F64, frame="sensor from ICRS", doc="Attitude.") for a in "xyzw"],
        *axes("{}_km", unit="km", frame="GCRF", doc="Position"),
        *axes("v{}_km_s", unit="km/s", frame="GCRF", null=True, doc="Velocity"),
        column("camera", I64, doc="Row of the sensor's `cameras` that is valid for the frame."),
    ],
)

TRACKLET_ENDS = schema(
    "tracklet_ends",
    "One row per tracklet of one sensor near a span: its ids, and its ends as far as they are near "
    "the span.",
    [
        *(field for field in TRACKLET_FIELDS if field.name in ("tracklet_id", "track_id")),
        time_column("start_time", doc="First detection, or where its rows begin, UTC."),
        time_column("end_time", doc="Last detection, or where its rows end, UTC."),
    ],
)

VIEWED_TRACKLETS = schema(
    "viewed_tracklets",
    "One row per tracklet of one sensor with views in a span: a row of `tracklet_ends`, and where "
    "its views are.",
    [
        *TRACKLET_ENDS,
        column("first_view", I64, doc="Its first row in the sensor's views, sorted by tracklet."),
        column("n_views", I64, doc="Number of its views."),
    ],
)

OBJECT_MEMBERS = schema(
    "object_members",
    "One row per object, tracklet, and time in which the tracklet shows the object.",
    [
        column("object", I64, doc="Number of the object, in the block or in the night."),
        column("sensor", I64, doc="Number of the sensor in the run."),
        id_column("tracklet_id", doc="Its id in the night."),
        id_column("track_id", doc="Its track in the night."),
        time_column("first_epoch", doc="First epoch, UTC."),
        time_column("last_epoch", doc="Last epoch, UTC."),
        column("n_views", I64, doc="Number of views."),
        column("piece", I64, doc="Piece of the span in which the object is solved."),
    ],
)

SHARED_ERRORS = schema(
    "shared_errors",
    "One row per sensor whose shared errors are larger than stated: factors of their variances.",
    [
        SENSOR_ID,
        column("direction", F64, doc="Of the error of its directions."),
        column("position", F64, doc="Of the error of its position."),
    ],
)

TRUE_FRAMES = schema(
    "true_frames",
    "Simulation truth, one row per frame.",
    [
        id_column("sensor_id", doc="Star sensor."),
        column("frame_number", I64, doc="Exposure of the sensor."),
        column("t_ns", I64, unit="ns", doc="Mid-exposure time, UTC since 1970."),
        *[column(f"q{a}", F64, frame="sensor from ICRS", doc="True attitude.") for a in "xyzw"],
        *[column(a, F64, unit="km", frame="GCRF", doc="Sensor position.") for a in "xyz"],
        *[column(f"v{a}", F64, unit="km/s", frame="GCRF", doc="Sensor velocity.") for a in "xyz"],
    ],
)

TRUE_POINTS = schema(
    "true_points",
    "Simulation truth, one row per centroid.",
    [
        id_column("sensor_id", doc="Star sensor."),
        column("frame_number", I64, doc="Exposure of the sensor."),
        column("centroid", pa.int32(), doc="Index in the arrays of the frame's message."),
        column("kind", pa.int8(), doc="0 star, 1 object, 2 false point."),
        column("source", I64, doc="Star number, object index, or -1."),
        column(
            "magnitude",
            F64,
            unit="mag",
            null=True,
            doc="V as the sensor should see it; null where unknown.",
        ),
        column(
            "also",
            I64,
            null=True,
            doc="Index of a second object whose light is in the same centroid; null or -1: none.",
        ),
    ],
)

TRUE_ORBITS = schema(
    "true_orbits",
    "Simulation truth, one row per object and sampling time; cubic Hermite in between.",
    [
        column("object", I64, doc="Object index, as in `source` of `true_points`."),
        column("t_ns", I64, unit="ns", doc="UTC since 1970."),
        *[column(a, F64, unit="km", frame="GCRF", doc="Object position.") for a in "xyz"],
        *[column(f"v{a}", F64, unit="km/s", frame="GCRF", doc="Object velocity.") for a in "xyz"],
    ],
)

TRACKLET_OUTCOMES = schema(
    "tracklet_outcomes",
    "One row per tracklet that was compared with other sensors in a span, and its outcome there.",
    [
        id_column("tracklet_id", doc="Its id in the night."),
        column("outcome", pa.string(), doc="What became of it: an `Outcome`."),
    ],
)

TRACKLET_RUNS = schema(
    "tracklet_runs",
    "What tracking knows of a row of `tracklets`.",
    TRACKLET_FIELDS,
)

JUDGED_TRACKLETS = schema(
    "judged_tracklets",
    "A row of `tracklets` whose outcome is known.",
    [*TRACKLET_FIELDS, column("outcome", pa.string(), doc="What became of it: an `Outcome`.")],
)

ATTRIBUTABLES = schema(
    "attributables",
    "One row per tracklet of one sensor whose middle is in a span and that has a direction.",
    [id_column("tracklet_id", doc="Its id in the night."), *ATTRIBUTABLE_FIELDS],
)

LINKED_TRACKLETS = schema(
    "linked_tracklets",
    "One row per tracklet that an orbit joins to an object.",
    [
        id_column("tracklet_id", doc="Its id in the night."),
        id_column("object_id", doc="The object."),
    ],
)

LINKED_ORBITS = schema(
    "linked_orbits",
    "One row per object that has linked tracklets only: the orbit that joins them.",
    [
        id_column("object_id", doc="The object."),
        time_column("epoch", doc="Of the state, UTC."),
        *axes("{}_km", unit="km", frame="GCRF", doc="Position"),
        *axes("v{}_km_s", unit="km/s", frame="GCRF", doc="Velocity"),
    ],
)

HOT_SUSPECTS = schema(
    "hot_suspects",
    "One row per tracklet of one sensor that is a hot pixel, unless another sensor sees an object "
    "there.",
    [id_column("tracklet_id", doc="Id in the span, or in the night.")],
)

CLOCK_LINES = schema(
    "clock_lines",
    "One row per view of an object, at some epochs: what the check of the sensors needs.",
    [
        *[
            VIEWS.field(name)
            for name in ("epoch", "sensor_id", "frame_number", "tracklet_id", "ux", "uy", "uz")
        ],
        *[field for field in VIEWS if field.name.startswith("cov_")],
        *axes("sensor_{}_km", unit="km", frame="GCRF", doc="Sensor position at the epoch"),
        *axes("sensor_v{}_km_s", unit="km/s", frame="GCRF", doc="Sensor velocity at the epoch"),
        *[VIEWS.field(name) for name in ("attitude_rad2", "turn_noise_rad2", "field_part")],
        *[VIEWS.field(name) for name in ("first_fitted", "last_fitted", "position_sigma_km")],
        OBJECT_ID,
        *axes("{}_km", unit="km", frame="GCRF", doc="Object position when its light left"),
        *axes("v{}_km_s", unit="km/s", frame="GCRF", doc="Object velocity"),
        *covariance("cov_{}", unit="km^2", frame="GCRF", doc="Covariance of the position."),
    ],
)

OBJECT_VIEWS = schema(
    "object_views",
    "One row per view of an object, at the epochs of `clock_lines`, also where no line was kept.",
    [VIEWS.field(name) for name in ("epoch", "sensor_id", "tracklet_id")],
)

OBJECT_DETECTIONS = schema(
    "object_detections",
    "One row per detection of an object near midnight: two nights name the object alike by them.",
    [
        ASSOCIATIONS.field(name)
        for name in ("object_id", "sensor_id", "frame_number", "centroid", "used")
    ],
)

LAST_FRAMES = schema(
    "last_frames",
    "One row per sensor: its last frame before midnight. Two nights count its frames alike by it.",
    [FRAMES.field(name) for name in ("sensor_id", "frame_number", "time")],
)

MOVING_OBJECTS = schema(
    "moving_objects",
    "One row per object, at the epochs of `clock_lines`: where it is and how it moves.",
    [
        EPOCH,
        OBJECT_ID,
        *axes("{}_km", unit="km", frame="GCRF", doc="Object position"),
        *axes("v{}_km_s", unit="km/s", frame="GCRF", doc="Object velocity"),
        *covariance("cov_{}", unit="km^2", frame="GCRF", doc="Covariance of the position."),
        column("light_s", F64, unit="s", doc="Light time from the object to the epoch."),
    ],
)


# The content of one log, before its states are converted to GCRF.

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

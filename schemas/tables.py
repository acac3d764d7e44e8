"""The tables of a dataset, declared once: type, unit, frame and meaning of every column.

A dataset is ``DATASET/night=YYYY-MM-DD/<table>/<part>.parquet``. What is declared here
travels in the Parquet files as field metadata.
"""

import pyarrow as pa

from epipole.schemas.attributable import ATTRIBUTABLE_FIELDS
from epipole.schemas.columns import (
    STATE_AXES,
    axes,
    column,
    covariance,
    id_column,
    rate_unit,
    schema,
    time_column,
    upper_triangle,
)
from epipole.schemas.object_summary import OBJECT_FIELDS
from epipole.schemas.observation import FITTED_FIELDS, SIGHTED_FIELDS
from epipole.schemas.orbit import ORBIT_FIELDS
from epipole.schemas.sensor_error import SENSOR_ERROR_FIELDS

F64 = pa.float64()
I32 = pa.int32()
I64 = pa.int64()

SENSOR_ID = id_column("sensor_id", doc="Star sensor.")
FRAME_NUMBER = column(
    "frame_number", I64, doc="Exposure of the sensor; with sensor_id, the key of a frame."
)
FRAME_TIME = time_column()
FRAME_KEY = [SENSOR_ID, FRAME_NUMBER, FRAME_TIME]
CENTROID = column("centroid", I32, doc="Index in the arrays of the frame's message.")
PIXEL = axes(
    "{}_px",
    unit="px",
    frame="image",
    doc="Place in the image; (0, 0) is the middle of the top-left pixel",
    names="xy",
)
EPOCH = time_column("epoch", doc="Common instant at which the sensors are compared, UTC.")
OBJECT_ID = id_column("object_id", doc="Space object; it keeps its id as long as it is followed.")

FRAMES = schema(
    "frames",
    "One row per frame: its attitude and where the sensor was.",
    [
        *FRAME_KEY,
        column("n_centroids", I32, doc="Centroids in the message."),
        column("n_stars", I32, doc="Centroids identified as stars and used for the attitude."),
        column(
            "attitude_source",
            pa.string(),
            doc="Where the attitude comes from: stars, prior or none.",
        ),
        column(
            "status",
            pa.string(),
            null=True,
            doc="Why there is no attitude from stars: no_centroids, too_few_stars, no_match, "
            "not_searched, search_limit, no_calibration, time_limit; null where there is one.",
        ),
        *[
            column(
                f"q{a}",
                F64,
                null=True,
                frame="sensor from ICRS",
                doc="Attitude: unit quaternion, scalar last, qw >= 0; turns ICRS into sensor "
                "components. Null without attitude.",
            )
            for a in "xyzw"
        ],
        column("ra_deg", F64, unit="deg", frame="ICRS", null=True, doc="Boresight."),
        column("dec_deg", F64, unit="deg", frame="ICRS", null=True, doc="Boresight."),
        column(
            "roll_deg",
            F64,
            unit="deg",
            frame="ICRS",
            null=True,
            doc="Position angle of the sensor's -y axis at the boresight, from celestial north "
            "through east, 0 to 360.",
        ),
        *axes(
            "sigma_{}_arcsec",
            unit="arcsec",
            frame="sensor",
            null=True,
            doc="1-sigma attitude error about the sensor axis, the errors that frames share "
            "(fitted optics, an unknown velocity of the sensor) included",
        ),
        column("residual_px", F64, unit="px", null=True, doc="Rms of the stars' image residuals."),
        *axes("{}_km", unit="km", frame="GCRF", null=True, doc="Sensor position"),
        *axes("v{}_km_s", unit="km/s", frame="GCRF", null=True, doc="Sensor velocity"),
        column(
            "position_sigma_km",
            F64,
            unit="km",
            null=True,
            doc="1-sigma error of the sensor position, per axis, as the log tells it; null where "
            "it tells none. Such errors are mostly common to many frames of the sensor.",
        ),
    ],
)

STARS = schema(
    "stars",
    "One row per identified star.",
    [
        *FRAME_KEY,
        CENTROID,
        column("star_id", I64, doc="Number in the catalogue that the table's metadata names."),
        column("magnitude", F64, unit="mag", doc="V magnitude in the catalogue."),
        *PIXEL,
        *axes(
            "d{}_px", unit="px", frame="image", doc="Measured minus predicted position", names="xy"
        ),
    ],
)

DETECTIONS = schema(
    "detections",
    "One row per centroid that is no star.",
    [
        *FRAME_KEY,
        CENTROID,
        *PIXEL,
        column("flux", F64, null=True, doc="Linear, any unit; null where unknown."),
        column(
            "ra_deg",
            F64,
            unit="deg",
            frame="ICRS",
            null=True,
            doc="Apparent direction; null in a frame without attitude.",
        ),
        column(
            "dec_deg",
            F64,
            unit="deg",
            frame="ICRS",
            null=True,
            doc="Apparent direction; null in a frame without attitude.",
        ),
        column(
            "sigma_arcsec",
            F64,
            unit="arcsec",
            doc="1-sigma per axis, of the centroid alone; `frames` has the attitude's error.",
        ),
        column(
            "kind",
            pa.string(),
            doc="What it is: object, star_unlisted, planet, hot_pixel or unknown.",
        ),
        id_column("tracklet_id", null=True, doc="Null where it belongs to no tracklet."),
        id_column(
            "track_id", null=True, doc="Null where it belongs to no track; only objects have one."
        ),
    ],
)


# What tracking knows of a tracklet.
TRACKLET_FIELDS = [
    id_column("tracklet_id", doc="Its id in the night."),
    id_column(
        "track_id", doc="Track that the tracklet belongs to; fragments of one object share it."
    ),
    SENSOR_ID,
    time_column("start_time", doc="First detection, UTC."),
    time_column("end_time", doc="Last detection, UTC."),
    column("n_detections", I32, doc="Detections of the tracklet."),
    column("rate_arcsec_s", F64, unit="arcsec/s", doc="Mean apparent rate on the sky."),
    column(
        "residual_px",
        F64,
        unit="px",
        doc="Rms distance of the detections from the local motion.",
    ),
    column(
        "link_chi2",
        F64,
        null=True,
        doc="Chi-square of the link to the fragment before; null for the first fragment.",
    ),
]

TRACKLETS = schema(
    "tracklets",
    "One row per tracklet: an unbroken run of detections of one object by one sensor. Its "
    "direction, rates and their covariance (an attributable) are all that one sensor tells of an "
    "orbit.",
    [
        *TRACKLET_FIELDS,
        column(
            "object_id",
            pa.string(),
            null=True,
            doc="The object that it shows; null: none found.",
        ),
        column("outcome", pa.string(), doc="What became of it: an `Outcome`."),
        *ATTRIBUTABLE_FIELDS,
    ],
)

EPOCHS = schema(
    "epochs",
    "One row per sensor and epoch: the frame that is used for it.",
    [
        EPOCH,
        SENSOR_ID,
        FRAME_NUMBER,
        column("dt_s", F64, unit="s", doc="Frame time minus epoch."),
    ],
)

ASSOCIATIONS = schema(
    "associations",
    "One row per view: an object at an epoch, seen by one sensor.",
    [
        EPOCH,
        OBJECT_ID,
        SENSOR_ID,
        FRAME_NUMBER,
        column(
            "centroid",
            I32,
            null=True,
            doc="Centroid in the nearest frame; null where the object was missed in it. Its "
            "position then comes from the tracklet.",
        ),
        id_column(
            "tracklet_id", null=True, doc="Null for a detection that belongs to no tracklet."
        ),
        *axes("{}_px", unit="px", frame="image", doc="Place at the epoch", names="xy"),
        column(
            "epipolar_px",
            F64,
            unit="px",
            doc="Distance from the epipolar lines of the other views, rms; of the eight with the "
            "least position error, where there are more.",
        ),
        column(
            "used",
            pa.bool_(),
            doc="False: the position was solved without it; it may be another object.",
        ),
    ],
)

POSITIONS = schema(
    "positions",
    "One row per object and epoch.",
    [
        EPOCH,
        time_column(
            doc="When the object was there, UTC: epoch minus the mean light time of the used views."
        ),
        OBJECT_ID,
        *axes("{}_km", unit="km", frame="GCRF", doc="Object position"),
        *covariance("cov_{}", unit="km^2", frame="GCRF", doc="Covariance of the position."),
        column("n_sensors", I32, doc="Sensors whose view was used."),
        column("n_rejected", I32, doc="Sensors whose view was rejected."),
        column("residual_px", F64, unit="px", doc="Rms of the used views' image residuals."),
        column("chi2", F64, doc="Weighted sum of squares; 2 n_sensors - 3 degrees of freedom."),
        column(
            "independent",
            pa.bool_(),
            before=False,
            doc="A position is fitted to the detections of some seconds before and after the "
            "epoch (`alignment.window_s`, 6 s unless set), so neighbouring rows of an object share "
            "detections: their errors correlate by 0.95 after 1 s, by half after 5 s, and not at "
            "all after 12 s. Rows with true share no detection with each other: fit an orbit to "
            "these only. What a sensor's frames have in common (its position, a prior attitude) "
            "is shared by all rows.",
        ),
    ],
)

OBSERVATIONS = schema(
    "observations",
    "One row per detection of a tracklet, whether or not another sensor saw its object, with all "
    "that an orbit determination from angles needs.",
    [
        FRAME_TIME,
        id_column(
            "tracklet_id", null=True, doc="Null for a detection that belongs to no tracklet."
        ),
        column(
            "object_id",
            pa.string(),
            null=True,
            doc="The object that it shows, also if only an orbit joins its tracklet to it; null "
            "where no object was found, or where the object's position was solved without it.",
        ),
        SENSOR_ID,
        FRAME_NUMBER,
        CENTROID,
        *SIGHTED_FIELDS,
        *FITTED_FIELDS,
    ],
)

STATES = schema(
    "states",
    "One row per object and arc: position and velocity at the arc's middle epoch.",
    [
        EPOCH,
        OBJECT_ID,
        *axes("{}_km", unit="km", frame="GCRF", doc="Object position"),
        *axes("v{}_km_s", unit="km/s", frame="GCRF", doc="Object velocity"),
        *[
            column(
                f"cov_{a}{b}",
                F64,
                unit=rate_unit("km", a, b),
                frame="GCRF",
                doc="State covariance.",
            )
            for a, b in upper_triangle(STATE_AXES)
        ],
        column("n_epochs", I32, doc="Epochs of the arc that share no detection."),
        column("n_views", I32, doc="Views that were fitted."),
        column("dof", I32, doc="Degrees of freedom of chi2: 2 n_views - 6."),
        column("chi2", F64, doc="Weighted sum of squares of the fit."),
    ],
)

ORBITS = schema(
    "orbits",
    "One row per object whose observations of the night fit one orbit: position and velocity at "
    "the middle of the arc, fitted to all its rows of `observations`.",
    [time_column("epoch", doc="Middle of the arc, UTC."), OBJECT_ID, *ORBIT_FIELDS],
)

OBJECTS = schema(
    "objects",
    "One row per object of the night, at a glance: when it was seen, how it was found, whether it "
    "is sound, how bright it is and its name.",
    [OBJECT_ID, *OBJECT_FIELDS],
)

IDENTIFICATIONS = schema(
    "identifications",
    "One row per object, and with a catalogue one per tracklet that belongs to none, compared "
    "with a catalogue of known objects.",
    [
        id_column("object_id", null=True, doc="Null in the row of a tracklet."),
        id_column("tracklet_id", null=True, doc="Null in the row of an object."),
        column("status", pa.string(), doc="A `NameStatus`: known, ambiguous or unknown."),
        id_column(
            "same_as",
            null=True,
            doc="Id of an earlier night that an object which is not known had there; null where "
            "it is new, or the motion does not decide. Objects followed over midnight keep their "
            "id.",
        ),
        column(
            "norad_id", I64, null=True, doc="Number in the satellite catalogue, where it is known."
        ),
        id_column("cospar_id", null=True, doc="International designator, such as 1998-067A."),
        column(
            "name",
            pa.string(),
            null=True,
            doc="Name in the catalogue. Of an ambiguous object: all that it may be, the likeliest "
            "first.",
        ),
        time_column(
            "element_epoch",
            null=True,
            doc="Epoch of the elements of the likeliest satellite, UTC; with the two columns that "
            "follow it is null where none is near. Of an unknown object all three are of the "
            "nearest one that it is not.",
        ),
        column(
            "distance_km",
            F64,
            unit="km",
            null=True,
            doc="Distance from its position; of a tracklet, and of an object without positions, "
            "that of the position from a line of sight.",
        ),
        column(
            "mahalanobis",
            F64,
            null=True,
            doc="The same in units of its standard deviation: of the elements, by their age, and "
            "of the position; of a tracklet with its rates.",
        ),
        column("probability", F64, null=True, doc="Of the status; null without a catalogue."),
        column(
            "catalogue", pa.string(), null=True, doc="Digest (sha256) of the catalogue's bytes."
        ),
    ],
)

_OPTICS = [
    ("fx_px", "px", "Focal length along columns."),
    ("fy_px", "px", "Focal length along rows; negative where rows count upward."),
    ("cx_px", "px", "Principal point, column."),
    ("cy_px", "px", "Principal point, row."),
    ("k1", "", "Brown-Conrady radial."),
    ("k2", "", "Brown-Conrady radial."),
    ("p1", "", "Brown-Conrady tangential."),
    ("p2", "", "Brown-Conrady tangential."),
    ("k3", "", "Brown-Conrady radial."),
]

CALIBRATIONS = schema(
    "calibrations",
    "One row per sensor: its optics, fitted to its stars of the night; of several calibrations the "
    "one with most stars.",
    [
        SENSOR_ID,
        *[column(name, F64, unit=unit, doc=doc) for name, unit, doc in _OPTICS],
        *[
            column(f"sigma_{name}", F64, unit=unit, doc=f"1-sigma of {name}.")
            for name, unit, _ in _OPTICS
        ],
        column("k4", F64, before=0.0, doc="Of the eighth power; as the log states it."),
        column(
            "fisheye",
            pa.bool_(),
            before=False,
            doc="Without distortion, the distance from the principal point is the angle from the "
            "boresight times the focal length (ROS's equidistant).",
        ),
        column("n_stars", I32, doc="Star images used in the fit."),
        column("residual_px", F64, unit="px", doc="Rms of their image residuals."),
    ],
)

SENSOR_ERRORS = schema(
    "sensor_errors",
    "One row per sensor whose observations are in orbits: the errors that all its directions "
    "share, as all orbits of the night together show them. None where common objects connect more "
    "than 1,000 sensors.",
    [SENSOR_ID, *SENSOR_ERROR_FIELDS],
)

CHECKS = schema(
    "checks",
    "One row per sensor and check of its logs: units, reference frame, times, cameras, as they "
    "were written.",
    [
        SENSOR_ID,
        column("check", pa.string(), doc="What was checked: a `LogCheck`."),
        column("verdict", pa.string(), doc="sound, wrong or unknown."),
        column(
            "cause",
            pa.string(),
            null=True,
            doc="The mistake, or why it is unknown: a `LogCause`; null where it is sound.",
        ),
        column("value", F64, null=True, doc="What was measured; null where nothing could be."),
        column("sigma", F64, null=True, doc="Its 1-sigma error; null where it has none."),
        column("expected", F64, null=True, doc="What it is in a sound log; null where unknown."),
        column("unit", pa.string(), null=True, doc="Of these three; null for numbers and shares."),
        column("sentence", pa.string(), doc="The evidence, and what to do."),
    ],
)

PAIRS = schema(
    "pairs",
    "One row per pair of detections of one object by two sensors: each with the reference, which "
    "has the least position error. All pairs: `positions.all_pairs`.",
    [
        EPOCH,
        id_column("sensor_id_1", doc="First sensor, that of the reference."),
        column("frame_number_1", I64, doc="Frame of the first sensor."),
        column("centroid_1", I32, doc="Centroid in that frame."),
        id_column("sensor_id_2", doc="Second sensor."),
        column("frame_number_2", I64, doc="Frame of the second sensor."),
        column("centroid_2", I32, doc="Centroid in that frame."),
        column(
            "epipolar_px",
            F64,
            unit="px",
            doc="Distance of the second from the epipolar line of the first, both at the epoch.",
        ),
        column("mahalanobis", F64, doc="That distance in units of its standard deviation."),
    ],
)

SOURCES = schema(
    "sources",
    "One row per log that the night was made from.",
    [
        column("name", pa.string(), doc="File name of the log."),
        column("size", I64, unit="byte", doc="Size of the log."),
        column("sha256", pa.string(), doc="Digest of its bytes."),
        time_column("first_time", doc="First frame in the log, UTC; see `last_time`."),
        time_column(
            "last_time",
            doc="Last frame in the log, UTC; of a log without frames, its last state; without "
            "these either, the last frame of the run.",
        ),
        column("code_version", pa.string(), doc="Version of epipole that made the night."),
        column("settings_key", pa.string(), doc="Digest of the settings that made the night."),
    ],
)

# Parquet calls the items "element"; under another name a table would not be as it was written.
TEXTS = pa.list_(pa.field("element", pa.string()))

_COUNTS = [
    ("logs", "Logs that it was made from."),
    ("sensors", "Star sensors."),
    ("frames", "Rows of `frames`."),
    ("identified", "Frames with an attitude from stars."),
    ("stars", "Rows of `stars`."),
    ("detections", "Rows of `detections`."),
    ("tracklets", "Rows of `tracklets`."),
    ("epochs", "Different epochs in `epochs`."),
    ("objects", "Rows of `objects`."),
    ("positions", "Rows of `positions`."),
    ("left_out", "Sum of the counts in `rejects`."),
]

NIGHTS = schema(
    "nights",
    "One row: what the night was made from and with, and what it holds. Two nights of one date "
    "whose keys are all equal are the same, byte for byte.",
    [
        column(
            "logs_key",
            pa.string(),
            doc="Digest of the logs: their names, and their bytes to the night's end.",
        ),
        column("settings_key", pa.string(), doc="Digest of the settings."),
        column("star_catalogue_key", pa.string(), doc="Digest of the star catalogue."),
        column("code_version", pa.string(), doc="Version of epipole."),
        column("code_key", pa.string(), doc="Digest of its code, and versions of libraries."),
        column(
            "known_key",
            pa.string(),
            null=True,
            doc="Digest (sha256) of the catalogue of known objects; null without one.",
        ),
        column("earlier_key", pa.string(), doc="Digest of these keys of the nights before."),
        *[column(name, I64, doc=doc) for name, doc in _COUNTS],
        column("sensor_ids", TEXTS, before=[], doc="The star sensors that have frames."),
        column("faults", TEXTS, doc="Sensors at fault, a sentence each."),
        column(
            "residuals",
            TEXTS,
            doc="Sensors by their known objects, a sentence each.",
        ),
    ],
)

REJECTS = schema(
    "rejects",
    "One row per thing that was left out, or per group of equal ones.",
    [
        column(
            "source",
            pa.string(),
            null=True,
            doc="Log file; null where it is about none, or more than one.",
        ),
        column("offset", I64, unit="byte", null=True, doc="Place in the log."),
        id_column("sensor_id", null=True, doc="Null where unknown, or more than one."),
        id_column("tracklet_id", null=True, doc="Null where it is not about one tracklet."),
        time_column(
            "time", doc="Time of what was left out, UTC; the start of the night if it has no time."
        ),
        column("stage", pa.string(), doc="Stage that left it out."),
        column("reason", pa.string(), doc="Why: a `Reason`."),
        column("count", I64, doc="How many."),
    ],
)

TABLES: dict[str, pa.Schema] = {
    "frames": FRAMES,
    "stars": STARS,
    "detections": DETECTIONS,
    "tracklets": TRACKLETS,
    "epochs": EPOCHS,
    "associations": ASSOCIATIONS,
    "positions": POSITIONS,
    "observations": OBSERVATIONS,
    "states": STATES,
    "orbits": ORBITS,
    "objects": OBJECTS,
    "identifications": IDENTIFICATIONS,
    "calibrations": CALIBRATIONS,
    "sensor_errors": SENSOR_ERRORS,
    "checks": CHECKS,
    "pairs": PAIRS,
    "sources": SOURCES,
    "nights": NIGHTS,
    "rejects": REJECTS,
}

"""Why something was left out: reasons of `rejects`, outcomes of tracklets, statuses of frames.

Each has a sentence, which the documentation shows. A reason also has its stage, and traits that
other modules ask for. `reject_rows` makes the rows of `rejects`.
"""

from collections.abc import Sequence
from enum import Flag, StrEnum, auto
from typing import Any

import numpy as np
import pyarrow as pa

from epipole.schemas.bridge import table
from epipole.schemas.log_messages import SENSOR_ID_RULE
from epipole.schemas.stages import Declared, Stage
from epipole.schemas.tables import REJECTS


class Trait(Flag):
    """What else is true of a reason."""

    PLAIN = 0
    HARMLESS = auto()  # normal in a night; others are logs that were not stored as recorded
    INVALID_CALIBRATION = auto()  # a calibration of a log is not used
    SENSOR_FAULT = auto()  # a sensor is at fault and left out
    SUMMED = auto()  # summed over a night's spans: one row per span would add nothing


class Reason(StrEnum):
    """Why something was left out: the stage that did, a sentence, and traits."""

    stage: Stage
    sentence: str
    traits: Trait

    # The defaults are for type checkers: `Reason("nan")` looks a member up by its value.
    def __new__(
        cls,
        reason: str,
        stage: Stage = Stage.READ,
        sentence: str = "",
        traits: Trait = Trait.PLAIN,
    ) -> "Reason":
        """Return a member whose value is the reason alone."""
        member = str.__new__(cls, reason)
        member._value_ = reason
        member.stage, member.sentence, member.traits = stage, sentence, traits
        return member

    @classmethod
    def having(cls, trait: Trait) -> list["Reason"]:
        """Return the reasons with a trait, in order."""
        return [reason for reason in cls if trait in reason.traits]

    # Of a file.
    NO_MCAP = (
        "no_mcap",
        Stage.READ,
        "A file that was found in a folder or by a glob is not an MCAP file.",
        Trait.HARMLESS,
    )
    NOTHING_READ = (
        "nothing_read",
        Stage.READ,
        "A log has no frame, state or calibration that can be used; offset is its size.",
        Trait.HARMLESS,
    )
    TRUNCATED = "truncated", Stage.READ, "The log ends too early: cut short, or never closed."
    LOG_BEHIND_LOG = (
        "log_behind_log",
        Stage.READ,
        "A second log begins after the end of the first; both are read.",
    )
    DAMAGED_RECORD = "damaged_record", Stage.READ, "A record of the log is damaged."
    MISSING_MESSAGES = (
        "missing_messages",
        Stage.READ,
        "The log's summary, or the index of a chunk, counts more messages than the log holds.",
    )
    UNKNOWN_CHANNEL = (
        "unknown_channel",
        Stage.READ,
        "Messages of a channel that the log does not declare.",
    )
    UNKNOWN_SCHEMA = (
        "unknown_schema",
        Stage.READ,
        "Messages of a channel whose schema the log does not declare.",
    )
    UNKNOWN_ENCODING = (
        "unknown_encoding",
        Stage.READ,
        "Messages of a channel in an encoding that is not registered.",
    )
    BAD_DATA_CHECKSUM = (
        "bad_data_checksum",
        Stage.READ,
        "The checksum of the log's data section does not fit; messages that no chunk's checksum "
        "covers are used where their values are valid.",
    )
    # Of a chunk, with the number of its messages where an index has it.
    BAD_CHECKSUM = "bad_checksum", Stage.READ, "The chunk's checksum does not fit its bytes."
    BAD_COMPRESSION = "bad_compression", Stage.READ, "The chunk cannot be decompressed."
    UNKNOWN_COMPRESSION = (
        "unknown_compression",
        Stage.READ,
        "The chunk is compressed by a method other than zstd and lz4.",
    )
    WRONG_CHUNK_SIZE = (
        "wrong_chunk_size",
        Stage.READ,
        "The chunk's declared size is not the size of its content.",
    )
    CHUNK_TOO_LARGE = (
        "chunk_too_large",
        Stage.READ,
        "The chunk declares more bytes than allowed, by itself or with those before it.",
    )
    DAMAGED_CHUNK = "damaged_chunk", Stage.READ, "The records in the chunk are damaged."
    # Of any message.
    UNDECODABLE_FRAME = "undecodable_frame", Stage.READ, "A frame's message cannot be decoded."
    UNDECODABLE_STATE = "undecodable_state", Stage.READ, "A state's message cannot be decoded."
    UNDECODABLE_CALIBRATION = (
        "undecodable_calibration",
        Stage.READ,
        "A calibration's message cannot be decoded.",
        Trait.INVALID_CALIBRATION,
    )
    BAD_SENSOR_ID = (
        "bad_sensor_id",
        Stage.READ,
        f"The sensor id is not what it has to be: {SENSOR_ID_RULE}.",
    )
    NO_TIMESTAMP = (
        "no_timestamp",
        Stage.READ,
        "The message has no timestamp, or one that is out of bounds.",
    )
    # Of a frame.
    NAN = "nan", Stage.READ, "The frame has a centroid whose position is not a finite number."
    BAD_CENTROID = (
        "bad_centroid",
        Stage.READ,
        "The frame has a centroid whose x_px or y_px is out of bounds.",
    )
    UNEQUAL_ARRAYS = "unequal_arrays", Stage.READ, "The frame's arrays differ in length."
    BAD_SIGMA = (
        "bad_sigma",
        Stage.READ,
        "The frame has a centroid whose sigma_px is invalid or out of bounds.",
    )
    BAD_EXPOSURE = (
        "bad_exposure",
        Stage.READ,
        "The frame's exposure_s is out of bounds; the frame is used, its exposure time unknown.",
    )
    BAD_FRAME_NUMBER = "bad_frame_number", Stage.READ, "The frame number is out of range."
    STRAY_TIME = (
        "stray_time",
        Stage.READ,
        "The frame's time is more than two days from the median time of its log's frames.",
    )
    DUPLICATE_FRAME = (
        "duplicate_frame",
        Stage.READ,
        "The same frame was already read; it counts once.",
        Trait.HARMLESS,
    )
    DUPLICATE_NUMBER = (
        "duplicate_number",
        Stage.READ,
        "Another frame of the sensor has the same number.",
    )
    RESTARTED_COUNTER = (
        "restarted_counter",
        Stage.READ,
        "The sensor's counter of frames restarted, or does not count; the frame is used, "
        "numbered on from the highest number before in the night.",
        Trait.HARMLESS,
    )
    DUPLICATE_TIME = "duplicate_time", Stage.READ, "Another frame of the sensor has the same time."
    # Of a state.
    UNKNOWN_FRAME = (
        "unknown_frame",
        Stage.READ,
        "The state's reference frame is not GCRF, EME2000, TEME or ITRF.",
    )
    BAD_POSITION = (
        "bad_position",
        Stage.READ,
        "The state's position_km is not three finite numbers, or is farther than ten million km.",
    )
    INSIDE_EARTH = "inside_earth", Stage.READ, "The state's position lies inside the Earth."
    BAD_VELOCITY = (
        "bad_velocity",
        Stage.READ,
        "The state's velocity_km_s is not three finite numbers, or is faster than 1,000 km/s.",
    )
    BAD_POSITION_SIGMA = (
        "bad_position_sigma",
        Stage.READ,
        "The state's position_sigma_km is above 1,000 km: the position is of no use.",
    )
    BAD_ATTITUDE = (
        "bad_attitude",
        Stage.READ,
        "The state's attitude_xyzw is not a unit quaternion; its position is used.",
    )
    VAGUE_ATTITUDE = (
        "vague_attitude",
        Stage.READ,
        "The state's attitude_sigma_arcsec is above 2 degrees, too vague to help; its position is "
        "used.",
    )
    WRONG_VELOCITY = (
        "wrong_velocity",
        Stage.READ,
        "The sensor's velocities contradict the path of its positions, as `checks` says; they are "
        "read as unknown.",
    )
    DUPLICATE_STATE = (
        "duplicate_state",
        Stage.READ,
        "Another state of the sensor has the same time; one with an attitude is kept, of several "
        "the one with the smallest position sigma.",
        Trait.HARMLESS,
    )
    # Of a calibration.
    BAD_IMAGE_SIZE = (
        "bad_image_size",
        Stage.READ,
        "The calibration's width or height is out of bounds.",
        Trait.INVALID_CALIBRATION,
    )
    BAD_CAMERA_MATRIX = (
        "bad_camera_matrix",
        Stage.READ,
        "The calibration's K is not a camera matrix without skew, or is out of bounds.",
        Trait.INVALID_CALIBRATION,
    )
    BAD_DISTORTION = (
        "bad_distortion",
        Stage.READ,
        "The calibration's D is not empty and has not 4 or 5 finite numbers (4 of a fisheye), or "
        "one that is out of bounds.",
        Trait.INVALID_CALIBRATION,
    )
    BAD_LINE_TIME = (
        "bad_line_time",
        Stage.READ,
        "The calibration's line_time_s is out of bounds.",
        Trait.INVALID_CALIBRATION,
    )
    FOLDED_IMAGE = (
        "folded_image",
        Stage.READ,
        "The calibration's D folds the image, and not only its corners: two directions would have "
        "one pixel position.",
        Trait.INVALID_CALIBRATION,
    )
    UNKNOWN_DISTORTION_MODEL = (
        "unknown_distortion_model",
        Stage.READ,
        "The calibration's distortion model is neither plumb_bob nor that of a fisheye "
        "(equidistant, fisheye, kannala_brandt).",
        Trait.INVALID_CALIBRATION,
    )
    # Of a sensor's frames.
    NO_CALIBRATION = (
        "no_calibration",
        Stage.IDENTIFY,
        "No calibration is valid for the frames.",
        Trait.SUMMED,
    )
    NO_STATE = (
        "no_state",
        Stage.IDENTIFY,
        "No state of the sensor is near enough in time, or its states give an impossible speed: "
        "the frames give no position.",
        Trait.SUMMED,
    )
    REPEATED_CENTROID = (
        "repeated_centroid",
        Stage.IDENTIFY,
        "Centroids at the very position of another one of their frame; the brightest is used.",
    )
    OUTSIDE_IMAGE = (
        "outside_image",
        Stage.IDENTIFY,
        "Centroids outside the image that the calibration states, or in its corners beyond the "
        "fold of the distortion; if they are many, its width, its height or its D is wrong.",
    )
    TOO_MANY_DETECTIONS = (
        "too_many_detections",
        Stage.IDENTIFY,
        "The sensor reports more detections than are followed: the faintest of its fullest frames.",
    )
    # Of tracklets and views.
    HOT_PIXEL = (
        "hot_pixel",
        Stage.TRACK,
        "Detections of hot pixels; with a tracklet_id: it stands on a pixel as a hot pixel does, "
        "and no other sensor sees an object there.",
    )
    SENSOR_DISAGREES = (
        "sensor_disagrees",
        Stage.SOLVE,
        "The sensor's lines of sight agree with no other sensor's; it is left out for that time.",
        Trait.SENSOR_FAULT,
    )
    AMBIGUOUS = (
        "ambiguous",
        Stage.SOLVE,
        "The tracklet could belong to more than one object, and the evidence does not decide.",
    )
    UNDECIDED = (
        "undecided",
        Stage.SOLVE,
        "Another sensor has a tracklet that may be of the same object, but the evidence is not "
        "enough.",
    )
    VIEW_REJECTED = (
        "view_rejected",
        Stage.SOLVE,
        "The view is too far from the object's position, which was solved without the view.",
        Trait.SUMMED,
    )
    NO_POSITION = (
        "no_position",
        Stage.SOLVE,
        "The views of the object have no common point, or are parallel within their errors.",
        Trait.SUMMED,
    )
    STATE_MISFIT = (
        "state_misfit",
        Stage.SOLVE,
        "The chi-square of an object's state does not fit its degrees of freedom, or its fit does "
        "not converge.",
    )
    MANOEUVRE = (
        "manoeuvre",
        Stage.PUBLISH,
        "The object changed its orbit at this time; its observations before are not in its orbit.",
    )
    ORBIT_MISFIT = (
        "orbit_misfit",
        Stage.PUBLISH,
        "The chi-square of an object's orbit does not fit its degrees of freedom: its observations "
        "are of more than one object, or it changed its orbit more than once.",
    )
    NO_ORBIT = (
        "no_orbit",
        Stage.PUBLISH,
        "No orbit is found for an object: it has too few observations, or the fit does not "
        "converge.",
    )
    CLOCK_OFF = (
        "clock_off",
        Stage.CHECK,
        "The sensor's clock is wrong, too far for its views to be used; they are left out.",
        Trait.SENSOR_FAULT | Trait.SUMMED,
    )
    EPHEMERIS_OFF = (
        "ephemeris_off",
        Stage.CHECK,
        "The sensor's ephemeris is wrong, too far for its views to be used; its attitude is right, "
        "by stars or by the other lines of sight; its views are left out.",
        Trait.SENSOR_FAULT,
    )
    ATTITUDE_OFF = (
        "attitude_off",
        Stage.CHECK,
        "The sensor's prior attitudes are wrong, too far for its views to be used; they are left "
        "out.",
        Trait.SENSOR_FAULT,
    )
    DISAGREES = (
        "disagrees",
        Stage.CHECK,
        "The sensor is at fault, and it is not clear whether by its clock, ephemeris or attitude; "
        "its views are left out.",
        Trait.SENSOR_FAULT,
    )
    # Of the catalogue of known objects.
    BAD_ELEMENTS = (
        "bad_elements",
        Stage.NAME,
        "A record of the catalogue of known objects is not a valid element set.",
    )
    OTHER_ELEMENTS = (
        "other_elements",
        Stage.NAME,
        "The catalogue has another element set of the object, nearer to the night.",
    )
    OLD_ELEMENTS = (
        "old_elements",
        Stage.NAME,
        "The epoch of the element set is too far from the night.",
    )
    FAILED_ELEMENTS = (
        "failed_elements",
        Stage.NAME,
        "SGP4 has no position for the element set, as of an object that has come down.",
    )


class Outcome(Declared):
    """What became of a tracklet. If several are true at different times, the first one counts."""

    OBJECT = "object", "It belongs to an object, and a position of the object was solved with it."
    LINKED = (
        "linked",
        "It belongs to an object by an orbit that also explains tracklets of other times or "
        "sensors; no position was solved with it.",
    )
    DISAGREES = (
        "disagrees",
        "It was associated with an object, but each position was solved without it (the reason "
        "`disagrees` is about a sensor).",
    )
    AMBIGUOUS = (
        "ambiguous",
        "It could belong to more than one object; the evidence does not decide.",
    )
    SENSOR_LEFT_OUT = (
        "sensor_left_out",
        "Its sensor was left out: its clock, ephemeris or attitude is wrong, or its lines of sight "
        "agree with no other's.",
    )
    UNDECIDED = (
        "undecided",
        "Another sensor has a tracklet that may be of the same object, but the evidence is not "
        "enough.",
    )
    SEEN_BY_ONE = (
        "seen_by_one",
        "No other sensor has a tracklet that fits one object with it.",
    )
    NOT_COMPARED = (
        "not_compared",
        "It was not compared with other sensors: it has no attitude, sensor position or epoch.",
    )


class Found(Declared):
    """How an object was found."""

    TOGETHER = "together", "Two sensors or more saw it at one time: it has positions."
    LINKED = "linked", "One orbit explains its tracklets, which are of different times."


class ObjectVerdict(Declared):
    """What is to be thought of an object. If several are true, the first one counts."""

    BLENDED = (
        "blended",
        "More than half of its observations may hold the light of a second object.",
    )
    TWO_SENSORS_DISAGREE = (
        "two_sensors_disagree",
        "Only two sensors have views of it, and these miss each other by more than their errors "
        "explain: it may be two objects.",
    )
    SENSORS_DISAGREE = (
        "sensors_disagree",
        "More than two sensors have views of it, which miss each other by more than their errors "
        "explain; or most of its positions were solved without one of the views.",
    )
    SENSORS_IN_DOUBT = (
        "sensors_in_doubt",
        "Sensors of the night disagree, and who is wrong is not clear: the errors of its positions "
        "are as large as that shows; see `checks`.",
    )
    MANOEUVRED = (
        "manoeuvred",
        "It changed its orbit: one orbit fits its observations before a time, another one those "
        "after it, and both meet then; `orbits` has the later one.",
    )
    ORBIT_MISFIT = (
        "orbit_misfit",
        "No single orbit fits its observations: they are of more than one object, or it changed "
        "its orbit more than once.",
    )
    NO_ORBIT = (
        "no_orbit",
        "Nothing is known against it, but no orbit is found: it has too few observations, or the "
        "fit does not converge.",
    )
    SOUND = (
        "sound",
        "One orbit fits its observations; of its directions at most one in twenty was left out.",
    )


class NameStatus(Declared):
    """What is known of an object's name."""

    KNOWN = "known", "It is one satellite of the catalogue."
    AMBIGUOUS = "ambiguous", "It may be one of several satellites, or none: `name` lists them."
    UNKNOWN = "unknown", "It is not in the catalogue, or there is no catalogue."


class FrameStatus(Declared):
    """Why a frame has no attitude from stars."""

    NO_CENTROIDS = "no_centroids", "The frame has no centroids."
    TOO_FEW_STARS = (
        "too_few_stars",
        "The frame has too few centroids, or its field too few stars.",
    )
    NO_MATCH = "no_match", "No attitude explains the centroids with enough certainty."
    NOT_SEARCHED = (
        "not_searched",
        "The searches of frames near it found nothing, so this one was only followed from others.",
    )
    TIME_LIMIT = "time_limit", "The search was stopped by its time limit."
    SEARCH_LIMIT = (
        "search_limit",
        "It was not searched, or not to the end: searches may cost a frame at most "
        "`identification.time_limit_s`, and a sensor's frames a tenth of it each on average.",
    )
    NO_CALIBRATION = "no_calibration", "No calibration is valid for the frame."


def sentence_of(reason: str) -> str:
    """Return what a reason in `rejects` means; a night of another version may have others."""
    known = {each.value: each.sentence for each in Reason}
    return known.get(reason, "A reason of another version of the program.")


def by_reason(rejects: pa.Table) -> dict[str, int]:
    """Return the counts of what was left out, by reason, the most frequent first."""
    counts = rejects.group_by("reason").aggregate([("count", "sum")])
    ordered = counts.sort_by([("count_sum", "descending"), ("reason", "ascending")])
    return {row["reason"]: row["count_sum"] for row in ordered.to_pylist()}


def left_out(rejects: pa.Table) -> list[str]:
    """Return a sentence for each reason in REJECTS, with its count; not for harmless ones."""
    counts = by_reason(rejects)
    return [
        f"{counts[reason]} {reason.value}: {reason.sentence}"
        for reason in Reason
        if reason in counts and Trait.HARMLESS not in reason.traits
    ]


def reject_rows(
    reason: Reason | Sequence[Reason],
    *,
    time: Any,
    count: Any,
    sensor_id: Any = None,
    source: Any = None,
    offset: Any = None,
    tracklet_id: Any = None,
) -> pa.Table:
    """Return rows of `rejects`: one per entry of `time`.

    Parameters
    ----------
    reason
        Of all rows, or one per row. It also gives the stage.
    time, count
        One per row: NumPy array, Arrow array or list. Times are int64 nanoseconds.
    sensor_id, source, offset, tracklet_id
        One per row, or one value for all; None: unknown, or more than one.
    """
    n = len(time)
    reasons = [reason] * n if isinstance(reason, Reason) else list(reason)
    columns = {
        "source": source,
        "offset": offset,
        "sensor_id": sensor_id,
        "tracklet_id": tracklet_id,
    }
    values = {name: _per_row(name, value, n) for name, value in columns.items()}
    return table(
        REJECTS,
        values
        | {
            "time": np.asarray(time, np.int64) if isinstance(time, list) else time,
            "stage": [reason.stage.value for reason in reasons],
            "reason": [reason.value for reason in reasons],
            "count": count,
        },
    )


def _per_row(name: str, value: Any, n: int) -> Any:
    if value is None or isinstance(value, str | int):
        return pa.array([value] * n, REJECTS.field(name).type)
    return value

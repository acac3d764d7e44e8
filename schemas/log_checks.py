"""What a log is checked for: checks, verdicts, and the mistakes that are named, with their cures.

The texts have the numbers of a finding in braces: `value`, `sigma`, `expected`, and its facts.
"""

from collections.abc import Iterable, Mapping, Sequence
from enum import StrEnum
from typing import Any, Self

from epipole.schemas.stages import Declared


class CheckVerdict(Declared):
    """The result of a check."""

    SOUND = "sound", "It is as stated, as far as the log shows."
    WRONG = "wrong", "It is not as stated; `cause` names the mistake."
    UNKNOWN = "unknown", "The log does not show it."


class LogCheck(StrEnum):
    """What is checked; `sentence` says what `value` is, `sound` is the text of a sound sensor."""

    sentence: str
    sound: str

    def __new__(cls, name: str, sentence: str = "", sound: str = "") -> Self:
        """Return a member whose value is the name alone."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.sentence, member.sound = sentence, sound
        return member

    LEFT_OUT_STATES = (
        "left_out_states",
        "States of the log that are beyond the bounds of what is possible, as a share of all.",
        "all states are within the bounds",
    )
    ONE_SENSOR = (
        "one_sensor", "States or frames of a second sensor with the same id.",
        "states and frames are of one sensor",
    )  # fmt: skip
    SMOOTHNESS = (
        "smoothness",
        "States that lie off the path of those around them.",
        "no state lies off the path of the others",
    )
    POSITION_UNIT = (
        "position_unit",
        "Acceleration of the positions beyond gravity, in units of gravity; of fewer than five "
        "states: energy of motion over what it takes to escape.",
        "positions are in kilometres",
    )
    REFERENCE_FRAME = (
        "reference_frame",
        "Acceleration of the positions beyond gravity in the stated frame, in units of gravity.",
        "positions fall freely in the stated frame, within {percent:.2g} % of gravity; GCRF, "
        "EME2000 and TEME cannot be told apart",
    )
    VELOCITY = (
        "velocity",
        "Stated velocity minus that of the path of positions.",
        "velocities are those of the positions, within {value:.2g} km/s",
    )
    POSITION_SIGMA = (
        "position_sigma",
        "Scatter of the positions about their path, per axis; expected: the stated sigma. An error "
        "that all share does not show.",
        "positions scatter by {value:.2g} km, stated are {expected:.2g} km; an error that all "
        "share does not show",
    )
    COVERAGE = (
        "coverage",
        "Share of the frames that have a state near.",
        "{percent:.3g} % of the frames have a state near",
    )
    FRAMES_ALL_NIGHT = (
        "frames_all_night",
        "Share of the night in which the sensor has no frames. A night lasts from the first frame "
        "of any sensor to the last; only a run compares them.",
        "there are frames all night, but for {percent:.2g} % of it",
    )
    FRAME_TIMES = (
        "frame_times",
        "Largest time, of a second and a tenth, of which all times of frames are multiples.",
        "times of frames are not rounded to a tenth of a second",
    )
    PRINCIPAL_POINT = (
        "principal_point",
        "Distance of the principal point from the middle of the image.",
        "the principal point is in the image",
    )
    IMAGE_SIZE = (
        "image_size", "Share of the centroids outside the image.", "centroids lie in the image"
    )  # fmt: skip
    FLUX = (
        "flux",
        "Where the median flux lies between the smallest and the largest, 0 to 1.",
        "fluxes are linear",
    )
    EXPOSURE_TIME = (
        "exposure_time",
        "Median exposure time over the median time from frame to frame.",
        "exposures end before the next frame",
    )
    CALIBRATION = "calibration", "Calibrations of the sensor.", "there is a calibration"
    CENTROID_SIGMA = (
        "centroid_sigma",
        "Scatter of the stars about their catalogue positions, per axis; expected: their stated "
        "sigma. Before a run: the median stated sigma.",
        "stars scatter by {value:.2g} px, stated are {expected:.2g} px",
    )
    LINES_OF_SIGHT = (
        "lines_of_sight",
        "Share of the tracklets that meet one of another sensor at the same times, as the states "
        "are written; only a run compares them.",
        "{percent:.3g} % of its tracklets meet those of other sensors",
    )
    SENSORS_AGREE = (
        "sensors_agree",
        "Error that was added to the positions of all sensors, per axis: only a run in which "
        "sensors disagree has it, where who is wrong is not clear.",
        "sensors agree",
    )
    SENSOR_FAULT = (
        "sensor_fault",
        "Error that is left of a sensor's fault, per axis; only a run has it.",
        "the sensor is not at fault",
    )
    UTC_TIMES = (
        "utc_times",
        "Written times minus UTC, by satellites of the catalogue; only a run with one compares "
        "them.",
        "times are UTC within {within_s:.2g} s, by {known:.0f} tracklets of known satellites",
    )


class LogCause(StrEnum):
    """A mistake, or why a check has no result; `evidence` shows it, `cure` says what to do."""

    verdict: CheckVerdict
    evidence: str
    cure: str

    def __new__(
        cls,
        name: str,
        verdict: CheckVerdict = CheckVerdict.WRONG,
        evidence: str = "",
        cure: str = "",
    ) -> Self:
        """Return a member whose value is the name alone."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.verdict, member.evidence, member.cure = verdict, evidence, cure
        return member

    # Of positions and velocities.
    POSITIONS_IN_M = (
        "positions_in_m",
        CheckVerdict.WRONG,
        "positions are in metres: times 0.001 they fall freely",
        "write position_km in kilometres, or assume the unit (`--assume`)",
    )
    INERTIAL_STATES = (
        "inertial_states",
        CheckVerdict.WRONG,
        "positions are stated to be ITRF but fall freely in inertial axes (in the stated frame "
        "{percent:.3g} % of gravity is missing or too much)",
        "write GCRF, EME2000 or TEME as the states' frame, whichever it is",
    )
    EARTH_FIXED_STATES = (
        "earth_fixed_states",
        CheckVerdict.WRONG,
        "positions turn with the Earth, which their stated frame does not (there, {percent:.3g} % "
        "of gravity is missing or too much)",
        "write ITRF as the states' frame, with velocities relative to the turning Earth",
    )
    POSITION_AXES = (
        "position_axes",
        CheckVerdict.WRONG,
        "positions turn with the Earth about another axis than z, or the other way: axes are "
        "exchanged or negated",
        "write x, y, z in the order of the frame, right-handed, z to the north",
    )
    NO_FREE_FALL = (
        "no_free_fall",
        CheckVerdict.UNKNOWN,
        "positions do not fall freely in any frame ({percent:.3g} % of gravity is missing or too "
        "much): thrust, or a mistake that is not known",
    )
    ARC_TOO_SHORT = (
        "arc_too_short",
        CheckVerdict.UNKNOWN,
        "the states are too few, too short or too uncertain to tell",
    )
    TOO_FEW_STATES = "too_few_states", CheckVerdict.UNKNOWN, "the states are too few to tell"
    ON_THE_GROUND = (
        "on_the_ground",
        CheckVerdict.UNKNOWN,
        "the sensor is on the ground or in the air: no orbit shows how its positions are meant",
    )
    VELOCITIES_ZERO = (
        "velocities_zero",
        CheckVerdict.WRONG,
        "velocities are 0 where positions move at {speed_km_s:.3f} km/s",
        "leave velocity_km_s empty where it is unknown",
    )
    VELOCITIES_NEGATED = (
        "velocities_negated",
        CheckVerdict.WRONG,
        "velocities point backwards along the path of positions",
        "write the velocity as the change of the position per second",
    )
    VELOCITIES_IN_M_S = (
        "velocities_in_m_s",
        CheckVerdict.WRONG,
        "velocities are in m/s",
        "write velocity_km_s in km/s, or assume the unit (`--assume`)",
    )
    VELOCITIES_PER_MS = (
        "velocities_per_ms",
        CheckVerdict.WRONG,
        "velocities are a thousandth of what positions do",
        "write velocity_km_s in km/s",
    )
    VELOCITIES_INERTIAL = (
        "velocities_inertial",
        CheckVerdict.WRONG,
        "velocities are relative to axes that do not turn, positions are Earth-fixed",
        "write velocities relative to the turning Earth: subtract its rotation times the position",
    )
    VELOCITIES_EARTH_FIXED = (
        "velocities_earth_fixed",
        CheckVerdict.WRONG,
        "velocities are relative to the turning Earth, positions are not",
        "add the Earth's rotation times the position to the velocity",
    )
    VELOCITY_AXES = (
        "velocity_axes",
        CheckVerdict.WRONG,
        "velocities have other axes than positions: exchanged or negated",
        "write both in the axes of the same frame",
    )
    VELOCITIES_DISAGREE = (
        "velocities_disagree",
        CheckVerdict.WRONG,
        "velocities are {value:.3g} km/s off those of the path of positions ({speed_km_s:.3f} "
        "km/s)",
        "write the velocity in the axes and units of the position, or leave it empty",
    )
    VELOCITIES_UNCERTAIN = (
        "velocities_uncertain",
        CheckVerdict.UNKNOWN,
        "velocities are {value:.3g} km/s off those of the path of positions, which is no clear "
        "mistake",
    )
    NO_VELOCITIES = "no_velocities", CheckVerdict.UNKNOWN, "no velocities: they come from positions"
    SIGMA_TOO_SMALL = (
        "sigma_too_small",
        CheckVerdict.WRONG,
        "positions scatter by {value:.2g} km per axis, stated are {expected:.2g} km",
        "state the error that positions have, in kilometres, or 0 where it is unknown",
    )
    NO_SIGMA = (
        "no_sigma",
        CheckVerdict.UNKNOWN,
        "no error of positions is stated; they scatter by {value:.2g} km",
    )
    STATES_JUMP = (
        "states_jump",
        CheckVerdict.WRONG,
        "{value:.0f} of {states:.0f} states lie off the path of the others, by up to {jump_km:.3g} "
        "km",
        "leave these states out",
    )
    NO_PATH = "no_path", CheckVerdict.UNKNOWN, "states follow no smooth path"
    VELOCITIES_TOO_FAST = (
        "velocities_too_fast",
        CheckVerdict.WRONG,
        "{count:.0f} of {states:.0f} states are left out, their velocities are above 1,000 km/s or "
        "no numbers: m/s?",
        "write velocity_km_s in km/s, or assume the unit (`--assume`)",
    )
    POSITIONS_TOO_FAR = (
        "positions_too_far",
        CheckVerdict.WRONG,
        "{count:.0f} of {states:.0f} states are left out, their positions are beyond ten million "
        "km or no numbers: metres?",
        "write position_km in kilometres, or assume the unit (`--assume`)",
    )
    POSITIONS_TOO_NEAR = (
        "positions_too_near",
        CheckVerdict.WRONG,
        "{count:.0f} of {states:.0f} states are left out, their positions lie inside the Earth: "
        "another unit, or 0 for unknown?",
        "write position_km in kilometres from the Earth's middle; leave out what is unknown",
    )
    UNKNOWN_FRAME_NAME = (
        "unknown_frame_name",
        CheckVerdict.WRONG,
        "{count:.0f} of {states:.0f} states are left out, their frame has another name",
        "write GCRF, EME2000, TEME or ITRF",
    )

    # Of ids.
    TWO_SENSORS = (
        "two_sensors",
        CheckVerdict.WRONG,
        "states of two satellites {apart_km:.3g} km apart have this id",
        "give each sensor an id that no other has",
    )
    NUMBERS_ALTERNATE = (
        "numbers_alternate",
        CheckVerdict.WRONG,
        "frame numbers alternate between two counters: frames of two sensors have this id",
        "give each sensor an id that no other has",
    )
    NUMBERS_STAY = (
        "numbers_stay",
        CheckVerdict.WRONG,
        "{count:.0f} of {frames:.0f} frames have the number of the one before; of frames with one "
        "number the first is used, unless all have one",
        "count the frames of a sensor: a number that no other frame has",
    )
    TWO_CALIBRATIONS = (
        "two_calibrations",
        CheckVerdict.WRONG,
        "there are different calibrations of one time: two sensors have this id, or one of them "
        "is out of date",
        "give each sensor an id that no other has, and one calibration at a time",
    )

    # Of times.
    TIMES_CUT = (
        "times_cut",
        CheckVerdict.WRONG,
        "times of frames are cut or rounded to {value:.1g} s",
        "write the middle of the exposure, in nanoseconds",
    )
    WHOLE_TIMES = (
        "whole_times",
        CheckVerdict.UNKNOWN,
        "all times of frames are multiples of {value:.1g} s: exposures in step with the clock, or "
        "times that are cut",
    )
    FRAMES_AND_STATES_SHIFTED = (
        "frames_and_states_shifted",
        CheckVerdict.WRONG,
        "frames lie {shift_s:+.1f} s from the states, which last as long: {scale}",
        "write UTC in both, or assume `frames_ahead_s` (`--assume`)",
    )
    NO_STATE_NEAR = (
        "no_state_near",
        CheckVerdict.WRONG,
        "no frame has a state near: the first frame is {lead_s:+.0f} s from the first state, the "
        "last {trail_s:+.0f} s before the last",
        "write UTC in both, and states as long as there are frames",
    )
    FEW_STATES_NEAR = (
        "few_states_near",
        CheckVerdict.UNKNOWN,
        "only {percent:.3g} % of the frames have a state near",
    )
    NO_STATES = "no_states", CheckVerdict.UNKNOWN, "there are no states: no positions", ""

    # Of the night.
    NO_FRAMES = "no_frames", CheckVerdict.WRONG, "no frames in the whole night", ""
    LONG_GAPS = (
        "long_gaps",
        CheckVerdict.WRONG,
        "no frames for {lost_s:,.0f} s of the {length_s:,.0f} s of the night, the longest time "
        "from {gap_from} to {gap_to} UTC",
    )

    # Of images.
    PRINCIPAL_POINT_ZERO = (
        "principal_point_zero",
        CheckVerdict.WRONG,
        "the principal point is ({cx_px:.1f}, {cy_px:.1f}) in an image of {width:.0f} x "
        "{height:.0f} px: the corner",
        "write the principal point in K, the middle of the image where it is not known",
    )
    PRINCIPAL_POINT_OUTSIDE = (
        "principal_point_outside",
        CheckVerdict.UNKNOWN,
        "the principal point ({cx_px:.1f}, {cy_px:.1f}) lies outside the image",
    )
    WIDTH_AND_HEIGHT_EXCHANGED = (
        "width_and_height_exchanged",
        CheckVerdict.WRONG,
        "centroids reach to ({x_px:.0f}, {y_px:.0f}) in an image of {width:.0f} x {height:.0f} px: "
        "width and height are exchanged",
        "exchange width and height",
    )
    IMAGE_TOO_SMALL = (
        "image_too_small",
        CheckVerdict.WRONG,
        "centroids reach to ({x_px:.0f}, {y_px:.0f}) in an image of {width:.0f} x {height:.0f} px",
        "write the size of the image that centroids were measured in, and its camera matrix",
    )
    IMAGE_NOT_FILLED = (
        "image_not_filled",
        CheckVerdict.UNKNOWN,
        "centroids reach only to ({x_px:.0f}, {y_px:.0f}) in an image of {width:.0f} x "
        "{height:.0f} px: windowed, or pixels that were binned",
    )
    FEW_CENTROIDS = "few_centroids", CheckVerdict.UNKNOWN, "the centroids are too few to tell"
    NO_FLUX = "no_flux", CheckVerdict.UNKNOWN, "no fluxes"
    FLUX_IS_MAGNITUDE = (
        "flux_is_magnitude",
        CheckVerdict.WRONG,
        "fluxes look like magnitudes: {low:.1f} to {high:.1f}, most of them near the largest",
        "write flux linear, 10**(-0.4 magnitude), or leave it empty",
    )

    EXPOSURE_TOO_LONG = (
        "exposure_too_long",
        CheckVerdict.WRONG,
        "exposures last {exposure_s:.3g} s, and a frame follows another after {interval_s:.3g} s",
        "write exposure_s in seconds, 0 where it is unknown",
    )
    NO_CALIBRATION = (
        "no_calibration",
        CheckVerdict.WRONG,
        "{frames:,.0f} frames and no valid calibration: the sensor takes no part",
        "also name the log that has it, or write the calibration that `epipole calibrate` finds",
    )
    IMPOSSIBLE_CENTROID_SIGMA = (
        "impossible_centroid_sigma",
        CheckVerdict.WRONG,
        "stated errors of centroids are {value:.2g} px, and no camera measures stars so well",
        "write the 1-sigma error per axis in pixels, or leave sigma_px empty",
    )
    CENTROID_SIGMA_TOO_SMALL = (
        "centroid_sigma_too_small",
        CheckVerdict.WRONG,
        "stars scatter by {value:.2g} px, stated are {expected:.2g} px",
        "write the 1-sigma error per axis in pixels, or leave sigma_px empty",
    )
    CENTROID_SIGMA_TOO_LARGE = (
        "centroid_sigma_too_large",
        CheckVerdict.WRONG,
        "stars scatter by only {value:.2g} px, stated are {expected:.2g} px",
        "write the 1-sigma error per axis in pixels, or leave sigma_px empty",
    )
    NO_CENTROID_SIGMA = (
        "no_centroid_sigma",
        CheckVerdict.UNKNOWN,
        "no errors of centroids are stated: a run learns them from stars",
    )
    CENTROID_SIGMA_UNCOMPARED = (
        "centroid_sigma_uncompared",
        CheckVerdict.UNKNOWN,
        "stated errors of centroids are {value:.2g} px; only a run with identified stars "
        "compares them",
    )

    # Of lines of sight: with another reading they meet.
    OTHER_INERTIAL_FRAME = (
        "other_inertial_frame",
        CheckVerdict.WRONG,
        "{percent:.0f} % of the tracklets meet those of other sensors, {share_percent:.0f} % with "
        "states turned between TEME and GCRF (odds 10^{odds:.0f})",
        "write the frame that the states are in: GCRF for TEME, or TEME for GCRF",
    )
    AXES_OF_STATES = (
        "axes_of_states",
        CheckVerdict.WRONG,
        "{percent:.0f} % of the tracklets meet those of other sensors, {share_percent:.0f} % with "
        "the states' axes exchanged or negated (odds 10^{odds:.0f})",
        "write x, y, z of the frame in their order, right-handed, z to the north",
    )
    FRAMES_AND_STATES_APART = (
        "frames_and_states_apart",
        CheckVerdict.WRONG,
        "{percent:.0f} % of the tracklets meet those of other sensors, {share_percent:.0f} % with "
        "times of frames {offset_s:+.0f} s against those of states taken back (odds 10^{odds:.0f})",
        "write UTC in both, or assume `frames_ahead_s` (`--assume`)",
    )
    EARTH_FIXED_TIMES = (
        "earth_fixed_times",
        CheckVerdict.WRONG,
        "{percent:.0f} % of the tracklets meet those of other sensors, {share_percent:.0f} % with "
        "states turned by {offset_s:+.0f} s of the Earth's rotation (odds 10^{odds:.0f})",
        "write all times in UTC, not GPS or TAI: ITRF states were turned to GCRF at a wrong time",
    )
    EPHEMERIDES_EXCHANGED = (
        "ephemerides_exchanged",
        CheckVerdict.WRONG,
        "{percent:.0f} % of the tracklets meet those of other sensors, {share_percent:.0f} % with "
        "the ephemerides of these two exchanged (odds 10^{odds:.0f})",
        "write each sensor's states under its id",
    )
    NO_COMMON_OBJECTS = (
        "no_common_objects",
        CheckVerdict.UNKNOWN,
        "{percent:.3g} % of its tracklets meet those of other sensors, and no ordinary mistake "
        "explains it: they look at other objects, or the mistake is not known",
    )
    VIEWS_TOO_VAGUE = (
        "views_too_vague",
        CheckVerdict.UNKNOWN,
        "{percent:.0f} % of its tracklets meet those of other sensors, but {share_percent:.0f} % "
        "would without a common object: they are many, or their errors are large",
    )
    CLOCK_OFF = (
        "clock_off",
        CheckVerdict.WRONG,
        "lines of sight meet those of other sensors if its clock is {size:+.3f} s (sigma "
        "{size_sigma:.3f} s) off: {value:.2g} km of it per axis are left in its positions",
        "compare its clock; `alignment.correct_clocks` takes the offset off",
    )
    EPHEMERIS_OFF = (
        "ephemeris_off",
        CheckVerdict.WRONG,
        "lines of sight meet those of other sensors if its ephemeris is {size:.2f} km (sigma "
        "{size_sigma:.2f} km) off: its views were moved so, within {value:.2g} km per axis",
        "compare its ephemeris, frame of reference and times of states",
    )
    ATTITUDE_OFF = (
        "attitude_off",
        CheckVerdict.WRONG,
        "lines of sight meet those of other sensors if its prior attitudes are {size:.1f} arcsec "
        "(sigma {size_sigma:.1f} arcsec) off: its views were turned so, within {value:.2g} arcsec",
        "compare its attitudes and how the sensor is mounted",
    )
    SENSORS_IN_DOUBT = (
        "sensors_in_doubt",
        CheckVerdict.WRONG,
        "lines of sight of sensors miss each other, and who is wrong is not clear: the positions "
        "of all sensors got an error of {value:.2g} km per axis",
        "compare their ephemerides, clocks and frames of reference",
    )
    SHARED_OFFSET = (
        "shared_offset",
        CheckVerdict.WRONG,
        "lines of sight meet if times of frames are {offset_s:+.3f} s (sigma {sigma_s:.3f} s) from "
        "those of states, in all sensors; their positions got an error of {value:.2g} km per axis",
        "write UTC in both, and the middle of the exposure; or ephemerides are off along the orbit",
    )
    EXPOSURE_START = (
        "exposure_start",
        CheckVerdict.WRONG,
        "times of frames are {offset_s:+.3f} s (sigma {sigma_s:.3f} s) from those of states, by "
        "lines of sight: exposures last {exposure_s:.3g} s, so these are their starts",
        "write the middle of the exposure, or assume `frame_time` (`--assume`)",
    )
    EXPOSURE_END = (
        "exposure_end",
        CheckVerdict.WRONG,
        "times of frames are {offset_s:+.3f} s (sigma {sigma_s:.3f} s) from those of states, by "
        "lines of sight: exposures last {exposure_s:.3g} s, so these are their ends",
        "write the middle of the exposure, or assume `frame_time` (`--assume`)",
    )
    TIMES_NOT_UTC = (
        "times_not_utc",
        CheckVerdict.WRONG,
        "{known:.0f} of {tracklets:.0f} tracklets are known satellites if all times are "
        "{value:+.1f} s from UTC, {as_written:.0f} as they are written: {scale}",
        "write UTC in frames and states, or assume the time scale (`--assume`)",
    )
    FEW_KNOWN_SATELLITES = (
        "few_known_satellites",
        CheckVerdict.UNKNOWN,
        "{known:.0f} of {tracklets:.0f} tracklets are known satellites, which is too few to tell",
    )


LISTED = 4  # sensors that a sentence names
OF_ONE_SENSOR = (
    LogCause.LONG_GAPS, LogCause.CLOCK_OFF, LogCause.EPHEMERIS_OFF, LogCause.ATTITUDE_OFF,
)  # fmt: skip
MISTAKE_COLUMNS = ("sensor_id", "check", "verdict", "cause", "sentence")


def mistakes(checks: Iterable[Mapping[str, Any]]) -> list[str]:
    """Return a sentence for each mistake, with the sensors that have it.

    Gaps, and faults of sensors, have a sentence each.

    Parameters
    ----------
    checks
        Rows of the table `checks`: `MISTAKE_COLUMNS`.
    """
    sensors: dict[tuple[str, str], list[str]] = {}
    sentences: dict[tuple[str, str], str] = {}
    for row in checks:
        if row["verdict"] == CheckVerdict.WRONG:
            key = (row["check"], row["sentence" if row["cause"] in OF_ONE_SENSOR else "cause"])
            sensors.setdefault(key, []).append(row["sensor_id"])
            sentences.setdefault(key, row["sentence"])
    return [f"{_listed(sensors[key])}: {sentence}" for key, sentence in sentences.items()]


def _listed(sensors: Sequence[str]) -> str:
    if len(sensors) <= LISTED:
        return ", ".join(sensors)
    return f"{', '.join(sensors[:LISTED])} and {len(sensors) - LISTED} more"

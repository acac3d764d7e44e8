"""Findings: the result of one check of one sensor's log."""

from collections.abc import Mapping
from typing import NamedTuple

SOUND, WRONG, UNKNOWN = "sound", "wrong", "unknown"

# Checks.
POSITION_UNIT = "position_unit"
VELOCITY = "velocity"
REFERENCE_FRAME = "reference_frame"
POSITION_SIGMA = "position_sigma"
SMOOTHNESS = "smoothness"
ONE_SENSOR = "one_sensor"
COVERAGE = "coverage"
FRAMES_ALL_NIGHT = "frames_all_night"
FRAME_TIMES = "frame_times"
PRINCIPAL_POINT = "principal_point"
IMAGE_SIZE = "image_size"
FLUX = "flux"
EXPOSURE_TIME = "exposure_time"
CALIBRATION = "calibration"
CENTROID_SIGMA = "centroid_sigma"
LEFT_OUT_STATES = "left_out_states"
LINES_OF_SIGHT = "lines_of_sight"
SENSORS_AGREE = "sensors_agree"
SENSOR_FAULT = "sensor_fault"
UTC_TIMES = "utc_times"


class Finding(NamedTuple):
    """The result of one check.

    Attributes
    ----------
    check
        What was checked.
    verdict
        SOUND, WRONG or UNKNOWN.
    value, sigma, expected
        What was measured, its 1-sigma error, and what it is in a sound log, in `unit`; NaN where
        there is no such number.
    cause
        The mistake, or why it is unknown; empty where it is sound.
    facts
        Numbers for the sentence, by name.
    """

    check: str
    verdict: str
    value: float = float("nan")
    sigma: float = float("nan")
    expected: float = float("nan")
    unit: str = ""
    cause: str = ""
    facts: Mapping[str, float] = {}

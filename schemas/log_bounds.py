"""The bounds of every value in a log: what lies beyond is damage, and no kernel meets it.

They are wide: a value beyond them is impossible, not unlikely. `io.logs.messages` compares each
message with them; the compiled scans take their limits from here too.
"""

import math
from dataclasses import dataclass
from datetime import UTC, datetime

from epipole.schemas.rejects import Reason


@dataclass(frozen=True)
class Bound:
    """The minimum and maximum of a field; of a vector, of its length."""

    field: str
    minimum: float
    maximum: float
    unit: str
    reason: Reason | None  # of the row in `rejects`; None: the value becomes unknown
    why: str

    def __contains__(self, value: float) -> bool:
        return self.minimum <= value <= self.maximum  # false for NaN


def _ns(year: int) -> int:
    return int(datetime(year, 1, 1, tzinfo=UTC).timestamp()) * 1_000_000_000


# A frame farther than this from the median time of its log's frames has a stray clock: a log may
# be four days long.
FAR_FROM_LOG_NS = 2 * 86_400_000_000_000

ARCSEC_OF_HALF_A_TURN = 180 * 3600

TIME = Bound(
    "timestamp",
    _ns(1972),
    _ns(2100),
    "ns",
    Reason.NO_TIMESTAMP,
    "1972 to 2100: UTC with leap seconds begins in 1972; a clock that was never set says 1970.",
)

# Of a frame.
FRAME_NUMBER = Bound(
    "frame_number", 0, (1 << 63) - 1, "", Reason.BAD_FRAME_NUMBER, "A 64-bit integer with a sign."
)
EXPOSURE = Bound(
    "exposure_s",
    0.0,
    3600.0,
    "s",
    Reason.BAD_EXPOSURE,
    "0 is unknown. Beyond the bounds the frame is used as if the exposure time were unknown.",
)
CENTROID_POSITION = Bound(
    "x_px, y_px", -1e6, 1e6, "px", Reason.BAD_CENTROID, "Ten times the largest image, both ways."
)
FLUX = Bound(
    "flux",
    1e-30,
    1e30,
    "",
    None,
    "Beyond the bounds it is unknown, as where it is zero or negative.",
)
CENTROID_SIGMA = Bound(
    "sigma_px", 1e-6, 1e4, "px", Reason.BAD_SIGMA,
    "A millionth of a pixel to a tenth of an image. Below a thousandth it is unknown: no camera "
    "reaches that.",
)  # fmt: skip

# Of a state.
POSITION = Bound(
    "position_km",
    6340.0,
    1e7,
    "km",
    Reason.BAD_POSITION,
    "Above the polar radius, with room for errors (else `inside_earth`); far beyond the Moon. "
    "Positions in metres are farther.",
)
SPEED = Bound(
    "velocity_km_s",
    0.0,
    1000.0,
    "km/s",
    Reason.BAD_VELOCITY,
    "A third of a percent of the speed of light; ten million km away, Earth-fixed axes turn at "
    "730 km/s. Velocities in m/s are faster.",
)
POSITION_SIGMA = Bound(
    "position_sigma_km",
    0.0,
    1000.0,
    "km",
    Reason.BAD_POSITION_SIGMA,
    "0, negative and NaN are unknown. A position with a larger error is of no use.",
)
QUATERNION = Bound(
    "attitude_xyzw",
    0.99,
    1.01,
    "",
    Reason.BAD_ATTITUDE,
    "A unit quaternion, with room for rounding. Beyond the bounds the position is used alone.",
)
ATTITUDE_SIGMA = Bound(
    "attitude_sigma_arcsec",
    0.0,
    2 * 3600.0,
    "arcsec",
    Reason.VAGUE_ATTITUDE,
    "0, negative and NaN are unknown. A prior with a larger error does not help: the stars are "
    "searched without it. From 180 degrees on the attitude is unknown, which is not a reject.",
)

# Of a calibration.
IMAGE_SIDE = Bound(
    "width, height", 1, 100_000, "px", Reason.BAD_IMAGE_SIZE, "The largest sensors have 20,000."
)
FOCAL_LENGTH = Bound(
    "K",
    10.0,
    1e8,
    "px",
    Reason.BAD_CAMERA_MATRIX,
    "Of both focal lengths, without sign: the second is negative where rows count upward.",
)
FOCAL_RATIO = Bound(
    "K",
    0.1,
    10.0,
    "",
    Reason.BAD_CAMERA_MATRIX,
    "Of the two focal lengths: pixels are nearly square.",
)
CORNER = Bound(
    "K",
    0.0,
    math.tan(math.radians(60)),
    "",
    Reason.BAD_CAMERA_MATRIX,
    "Tangent of the angle from the boresight to the farthest corner: 60 degrees. Pinhole cameras "
    "have narrower fields; it also bounds the principal point.",
)
DISTORTION = Bound(
    "D",
    -1.0,
    1.0,
    "",
    Reason.BAD_DISTORTION,
    "Of each term at the farthest corner, as a share of the corner's distance.",
)
LINE_TIME = Bound(
    "line_time_s",
    -1e-3,
    1e-3,
    "s",
    Reason.BAD_LINE_TIME,
    "A thousand rows in a second: rolling shutters take microseconds a row.",
)

BOUNDS = {
    "frame": (TIME, FRAME_NUMBER, EXPOSURE, CENTROID_POSITION, FLUX, CENTROID_SIGMA),
    "state": (TIME, POSITION, SPEED, POSITION_SIGMA, QUATERNION, ATTITUDE_SIGMA),
    "calibration": (TIME, IMAGE_SIDE, FOCAL_LENGTH, FOCAL_RATIO, CORNER, DISTORTION, LINE_TIME),
}

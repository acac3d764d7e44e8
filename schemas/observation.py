"""Columns of an observation: what its sensor measured, and what its object's orbit adds."""

import pyarrow as pa

from epipole.schemas.columns import axes, column

SIGHTED_FIELDS = [
    column(
        "ra_deg",
        pa.float64(),
        unit="deg",
        frame="GCRF",
        doc="Astrometric direction from the sensor: the aberration by the sensor's geocentric "
        "velocity is removed (where that is known), the light time is not. It points to where "
        "the object was when its light left.",
    ),
    column("dec_deg", pa.float64(), unit="deg", frame="GCRF", doc="The same."),
    column(
        "sigma_ra_arcsec",
        pa.float64(),
        unit="arcsec",
        doc="1-sigma of ra times cos dec: of the centroid and of the frame's attitude. It is "
        "independent in each frame.",
    ),
    column("sigma_dec_arcsec", pa.float64(), unit="arcsec", doc="1-sigma of dec, of the same."),
    column("correlation", pa.float64(), doc="Of both."),
    column(
        "bias_sigma_arcsec",
        pa.float64(),
        unit="arcsec",
        doc="1-sigma per axis of what all frames of the sensor have in common: fitted optics, "
        "a prior attitude. 0 where nothing is known to be common.",
    ),
    column(
        "blended",
        pa.bool_(),
        before=False,
        doc="Whether it may hold the light of a second object of the same sensor. Both sigmas of "
        "the direction have that error; the magnitude's has not.",
    ),
    *axes("{}_km", unit="km", frame="GCRF", doc="Sensor position at that time"),
    *axes(
        "v{}_km_s",
        unit="km/s",
        frame="GCRF",
        null=True,
        doc="Sensor velocity; null where unknown",
    ),
    column(
        "position_sigma_km",
        pa.float64(),
        unit="km",
        doc="1-sigma of the sensor position, per axis: of the log, or of the settings where "
        "it tells none; larger where the objects show so. Mostly common to all frames of the "
        "sensor.",
    ),
    column(
        "magnitude",
        pa.float64(),
        unit="mag",
        null=True,
        doc="V by the frame's identified stars; null without flux, or without such stars.",
    ),
    column(
        "magnitude_sigma",
        pa.float64(),
        unit="mag",
        null=True,
        doc="1-sigma: of the flux and of the frame's zero point. An object's colour may differ "
        "from the stars'.",
    ),
]

FITTED_FIELDS = [
    column(
        "residual_sigma",
        pa.float64(),
        null=True,
        doc="Distance from the direction that its object's orbit predicts, in sigmas of its "
        "independent error: the root of a chi-square of two degrees of freedom, so its mean square "
        "is 2. The errors that the sensor shares are removed as this orbit shows them. Rows above "
        "5.25 were left out of the orbit where they are few. Null where the object has no orbit.",
    ),
    column(
        "range_km",
        pa.float64(),
        unit="km",
        null=True,
        doc="Distance of the object from the sensor, when its light left: by its orbit; without "
        "one between its positions, where these are at most 30 s apart. Null where neither is "
        "known; so are the three columns that follow.",
    ),
    column(
        "phase_deg",
        pa.float64(),
        unit="deg",
        null=True,
        doc="Angle at the object between the Sun and the sensor; 0: fully lit.",
    ),
    column(
        "sunlit",
        pa.bool_(),
        null=True,
        doc="Whether the middle of the Sun is seen from the object, past the Earth (a sphere "
        "without air).",
    ),
    column(
        "magnitude_1000_km",
        pa.float64(),
        unit="mag",
        null=True,
        doc="The magnitude as it would be from a distance of 1,000 km. Null without a magnitude, "
        "too.",
    ),
]

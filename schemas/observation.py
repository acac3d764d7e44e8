"""Columns of an observation: what its sensor measured."""

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

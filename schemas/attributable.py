"""Columns of an attributable: direction, rates and brightness of a tracklet at its middle."""

import pyarrow as pa

from epipole.schemas.columns import (
    ATTRIBUTABLE_AXES,
    axes,
    column,
    rate_unit,
    time_column,
    upper_triangle,
)

ATTRIBUTABLE_FIELDS = [
    time_column(
        "epoch", null=True, doc="Its middle, UTC; null where no detection has a direction."
    ),
    column(
        "ra_deg",
        pa.float64(),
        unit="deg",
        frame="GCRF",
        null=True,
        doc="Astrometric direction from the sensor at the epoch, as in `observations`.",
    ),
    column("dec_deg", pa.float64(), unit="deg", frame="GCRF", null=True, doc="The same."),
    column(
        "ra_rate_arcsec_s",
        pa.float64(),
        unit="arcsec/s",
        frame="GCRF",
        null=True,
        doc="Rate of ra at the epoch, times cos dec.",
    ),
    column(
        "dec_rate_arcsec_s",
        pa.float64(),
        unit="arcsec/s",
        frame="GCRF",
        null=True,
        doc="Rate of dec.",
    ),
    *[
        column(
            f"cov_{a}{b}",
            pa.float64(),
            unit=rate_unit("arcsec", a, b),
            frame="GCRF",
            null=True,
            doc="Covariance of ra (times cos dec), dec and their rates (vra, vdec), of errors that "
            "are independent in each frame: on the axes east and north of this direction. Compare "
            "directions and rates as vectors on them: at a pole, ra itself is unknown.",
        )
        for a, b in upper_triangle(ATTRIBUTABLE_AXES)
    ],
    column(
        "bias_sigma_arcsec",
        pa.float64(),
        unit="arcsec",
        null=True,
        doc="1-sigma per axis of what all tracklets of the sensor have in common, beyond the "
        "covariance; see `observations`.",
    ),
    *axes(
        "{}_km",
        unit="km",
        frame="GCRF",
        null=True,
        doc="Sensor position at the epoch; null where unknown",
    ),
    *axes(
        "v{}_km_s",
        unit="km/s",
        frame="GCRF",
        null=True,
        doc="Sensor velocity at the epoch; null where unknown",
    ),
    column(
        "position_sigma_km",
        pa.float64(),
        unit="km",
        null=True,
        doc="1-sigma of the sensor position, per axis, as in `observations`.",
    ),
    column(
        "magnitude",
        pa.float64(),
        unit="mag",
        null=True,
        doc="Mean V of its detections; null without flux, or without stars to compare with.",
    ),
    column("magnitude_sigma", pa.float64(), unit="mag", null=True, doc="1-sigma of the mean."),
    column(
        "magnitude_scatter",
        pa.float64(),
        unit="mag",
        null=True,
        doc="Standard deviation of the detections' magnitudes; null with fewer than two.",
    ),
]

"""Columns of a sensor's shared errors."""

import pyarrow as pa

from epipole.schemas.columns import SHARED_AXES, axes, column, upper_triangle

_UNITS = {(True, True): "arcsec^2", (True, False): "arcsec km", (False, False): "km^2"}

SENSOR_ERROR_FIELDS = [
    *axes(
        "direction_error_{}_arcsec",
        unit="arcsec",
        frame="GCRF",
        doc="What is added to its directions (unit vectors), measured minus true, the same at all "
        "times; only the parts across its lines of sight are seen",
    ),
    *axes("position_error_{}_km", unit="km", frame="GCRF", doc="Its position, stated minus true"),
    *[
        column(
            f"cov_{a}{b}",
            pa.float64(),
            unit=_UNITS[a.startswith("d"), b.startswith("d")],
            frame="GCRF",
            doc="Covariance of both errors: dx, dy, dz of the direction, x, y, z of the position.",
        )
        for a, b in upper_triangle(SHARED_AXES)
    ],
    column(
        "bias_sigma_arcsec",
        pa.float64(),
        unit="arcsec",
        doc="1-sigma error of its directions per axis as `observations` state it (rms): the prior.",
    ),
    column(
        "position_sigma_km",
        pa.float64(),
        unit="km",
        doc="1-sigma error of its position per axis as `observations` state it (rms): the prior.",
    ),
    column("n_objects", pa.int32(), doc="Orbits that have observations of it."),
    column("n_observations", pa.int32(), doc="These observations."),
]

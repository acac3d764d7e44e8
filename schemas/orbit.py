"""Columns of an orbit: state, what it was fitted to and with which forces, and its elements."""

import pyarrow as pa

from epipole.schemas.columns import STATE_AXES, axes, column, rate_unit, upper_triangle

_ELEMENTS = [
    ("a_km", "km", "Semi-major axis; negative for a hyperbola."),
    ("e", "", "Eccentricity."),
    ("i_deg", "deg", "Inclination."),
    ("raan_deg", "deg", "Right ascension of the ascending node."),
    ("argp_deg", "deg", "Argument of perigee."),
    ("mean_anomaly_deg", "deg", "Mean anomaly."),
]
_LONGITUDE = [
    (
        "longitude_deg",
        "deg",
        "Longitude at the epoch, east of Greenwich, -180 to 180. Null "
        "for an object that is not geostationary: beyond 200 km or 15 degrees of latitude from it.",
    ),
    (
        "drift_deg_day",
        "deg/day",
        "Change of longitude, east, over a sidereal day at the epoch. Null as the longitude.",
    ),
]

ORBIT_FIELDS = [
    *axes("{}_km", unit="km", frame="GCRF", doc="Object position"),
    *axes("v{}_km_s", unit="km/s", frame="GCRF", doc="Object velocity"),
    *[
        column(
            f"cov_{a}{b}",
            pa.float64(),
            unit=rate_unit("km", a, b),
            frame="GCRF",
            doc="State covariance: of the observations' independent errors, of the errors that "
            "each sensor's share, and of the areas over mass where `forces` has one.",
        )
        for a, b in upper_triangle(STATE_AXES)
    ],
    column("n_sensors", pa.int32(), doc="Sensors whose observations were fitted."),
    column("n_tracklets", pa.int32(), doc="Tracklets of these observations."),
    column("n_observations", pa.int32(), doc="Observations that were fitted."),
    column("arc_s", pa.float64(), unit="s", doc="From the first of them to the last."),
    column("chi2", pa.float64(), doc="Weighted sum of squares of the fit, shared errors included."),
    column("dof", pa.int32(), doc="Degrees of freedom of chi2: 2 n_observations - 6."),
    column(
        "forces",
        pa.string(),
        doc="Forces of the fit: mass of the Earth (GM), J2 to J4, ellipticity of the equator "
        "(C22), Sun, Moon; with the area over mass that was fitted, its coefficient included: "
        "radiation (in sunlight) for orbits above 1,000 km, drag (in the air) for low ones "
        "whose arc shows it.",
    ),
    *[
        column(name, pa.float64(), unit=unit, frame="GCRF", doc=f"{doc} Osculating, at the epoch.")
        for name, unit, doc in _ELEMENTS
    ],
    *[
        column(
            f"sigma_{name}", pa.float64(), unit=unit, doc=f"1-sigma of {name}, by the linear model."
        )
        for name, unit, _ in _ELEMENTS
    ],
    *[column(name, pa.float64(), unit=unit, null=True, doc=doc) for name, unit, doc in _LONGITUDE],
    *[
        column(f"sigma_{name}", pa.float64(), unit=unit, null=True, doc=f"1-sigma of {name}.")
        for name, unit, _ in _LONGITUDE
    ],
]

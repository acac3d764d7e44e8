"""Directions of one object by sensor, and the sensors' ephemerides, from the tables of a night."""

from collections.abc import Mapping

import numpy as np
import polars as pl

from epipole.io.ccsds.orbit_data import Ephemeris
from epipole.io.ccsds.tracking_data import Directions
from epipole.schemas.columns import PLACE, VELOCITY
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.sky import radec_from_unit, unit_from_radec
from epipole.tasks.algorithms.orbits.reference_frames import EME2000_FROM_GCRF


def directions(observations: pl.DataFrame, ephemerides: Mapping[str, str]) -> dict[str, Directions]:
    """Return the directions of one object by sensor, in the order of the names.

    Parameters
    ----------
    observations
        OBSERVATIONS of the object, sorted by time.
    ephemerides
        The file of each sensor's ephemeris.
    """
    by_sensor = observations.partition_by("sensor_id", as_dict=True)
    return {
        str(sensor): _of_sensor(rows, ephemerides[str(sensor)])
        for (sensor,), rows in sorted(by_sensor.items())
    }


def _of_sensor(rows: pl.DataFrame, ephemeris: str) -> Directions:
    u = unit_from_radec(*(np.radians(rows[name].to_numpy()) for name in ("ra_deg", "dec_deg")))
    ra_eme, dec_eme = (np.degrees(angle) for angle in radec_from_unit(u @ EME2000_FROM_GCRF.T))
    v = np.nan_to_num(rows.select(VELOCITY).to_numpy().astype(float))
    across = np.linalg.norm(np.cross(u, v), axis=1)
    ra, dec, bias, place = (
        float(rows[name].median())  # type: ignore[arg-type]
        for name in ("sigma_ra_arcsec", "sigma_dec_arcsec", "bias_sigma_arcsec",
                     "position_sigma_km")
    )  # fmt: skip
    return Directions(
        rows["time"].dt.epoch("ns").to_numpy(),
        ra_eme,
        dec_eme,
        rows["magnitude"].cast(pl.Float64).fill_null(float("nan")).to_numpy(),
        round(float(np.degrees(np.mean(across) / SPEED_OF_LIGHT_KM_S)), 6),
        ephemeris,
        [
            "Astrometric directions from the sensor, whose ephemeris (in GCRF) is named below.",
            "Aberration: that by the sensor's velocity around the Earth is removed from each",
            "direction (CORRECTION_ABERRATION_DIURNAL has the mean angle), the Earth's own with",
            "the stars. Light time is not removed.",
            f"1-sigma of each, median: RA cos DEC {ra:.3f}, DEC {dec:.3f} arcsec.",
            f"1-sigma of what all share: {bias:.3f} arcsec, sensor position {place:.4f} km.",
            "MAG: V by the identified stars of the frame.",
        ],
    )


def sensor_ephemeris(frames: pl.DataFrame) -> Ephemeris:
    """Return the ephemeris of one sensor from its FRAMES, those with a position and velocity."""
    known = frames.drop_nulls([*PLACE, *VELOCITY]).sort("time")
    known = known.unique("time", keep="first", maintain_order=True)
    return Ephemeris(
        known["time"].dt.epoch("ns").to_numpy(),
        known.select(*PLACE, *VELOCITY).to_numpy(),
        np.empty(0, np.int64),
        np.empty((0, 6, 6)),
    )

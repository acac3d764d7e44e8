"""Tables of a night for CCSDS messages: directions of an object by sensor, and ephemerides."""

from collections.abc import Mapping

import numpy as np
import polars as pl

from epipole.io.ccsds import Directions, Ephemeris
from epipole.schemas.bridge import stack_covariance
from epipole.schemas.columns import POSITION, STATE_AXES, VELOCITY
from epipole.tasks.algorithms.constants import SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.geometry.directions import radec_from_unit, unit_from_radec
from epipole.tasks.algorithms.orbits.orbit_fit import trajectory
from epipole.tasks.algorithms.orbits.reference_frames import EME2000_FROM_GCRF

# Directions of one object, and the ephemerides of the sensors.


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
    ra, dec, bias, position = (
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
            "direction (CORRECTION_ABERRATION_DIURNAL has the mean angle), that of the Earth with",
            "the stars. Light time is not removed.",
            f"1-sigma of each, median: RA cos DEC {ra:.3f}, DEC {dec:.3f} arcsec.",
            f"1-sigma of what all share: {bias:.3f} arcsec, sensor position {position:.4f} km.",
            "MAG: V by the identified stars of the frame.",
        ],
    )


def sensor_ephemeris(frames: pl.DataFrame) -> Ephemeris:
    """Return the ephemeris of one sensor from its FRAMES, those with a position and velocity."""
    known = frames.drop_nulls([*POSITION, *VELOCITY]).sort("time")
    known = known.unique("time", keep="first", maintain_order=True)
    return Ephemeris(
        known["time"].dt.epoch("ns").to_numpy(),
        known.select(*POSITION, *VELOCITY).to_numpy(),
        np.empty(0, np.int64),
        np.empty((0, 6, 6)),
    )


# Ephemerides of one object: each state, moved through the arc that it was fitted to.

HALF_ARC_S = 300.0  # a state is of an arc of ten minutes at most
STEPS = 60  # of an arc, at least
SECOND_NS = 1_000_000_000


def single_states(states: pl.DataFrame) -> list[Ephemeris]:
    """Return each of the STATES of one object by itself."""
    time_ns = states["epoch"].dt.epoch("ns").to_numpy()
    state = states.select(*POSITION, *VELOCITY).to_numpy()
    covariance = stack_covariance(states.to_arrow(), "cov_{}", STATE_AXES)
    return [
        Ephemeris(time_ns[k : k + 1], state[k : k + 1], time_ns[k : k + 1], covariance[k : k + 1])
        for k in range(len(time_ns))
    ]


def arcs(states: pl.DataFrame, positions: pl.DataFrame) -> list[Ephemeris]:
    """Return an ephemeris for each of the STATES of one object, in order of time.

    It covers the object's POSITIONS about the state's epoch: point mass and J2 from there, and the
    covariance at the epoch and at both ends.
    """
    seen_ns = positions["epoch"].dt.epoch("ns").to_numpy()
    return [_arc(state, seen_ns) for state in single_states(states.sort("epoch"))]


def _arc(of: Ephemeris, seen_ns: np.ndarray) -> Ephemeris:
    epoch_ns = int(of.time_ns[0])
    since_s = (seen_ns - epoch_ns) / SECOND_NS
    inside = since_s[np.abs(since_s) <= HALF_ARC_S]
    first, last = min(inside.min(initial=0.0), -1.0), max(inside.max(initial=0.0), 1.0)
    step = (last - first) / STEPS
    later = np.linspace(0.0, last, int(np.ceil(last / step)) + 1)
    earlier = np.linspace(0.0, first, int(np.ceil(-first / step)) + 1)
    at_s = np.concatenate([later, earlier[1:]])  # outwards from the epoch: the fastest order
    state, transition = trajectory(of.state[0], at_s)
    order = np.argsort(at_s, kind="stable")
    time_ns = epoch_ns + np.rint(at_s * SECOND_NS).astype(np.int64)
    chosen = order[[0, int(np.flatnonzero(order == 0)[0]), -1]]
    covariance = transition[chosen] @ of.covariance[0] @ np.swapaxes(transition[chosen], 1, 2)
    return Ephemeris(time_ns[order], state[order], time_ns[chosen], covariance)

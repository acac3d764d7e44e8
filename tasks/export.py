"""Tables of a night for CCSDS messages: directions by sensor, states and ephemerides in a frame."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import polars as pl

from epipole.io.catalogues.earth_orientation import read_earth_orientation
from epipole.io.ccsds import Directions, Ephemeris, Subject
from epipole.schemas.bridge import stack_covariance
from epipole.schemas.columns import POSITION, STATE_AXES, VELOCITY
from epipole.schemas.rejects import NameStatus
from epipole.tasks.algorithms.constants import SECOND_NS, SPEED_OF_LIGHT_KM_S
from epipole.tasks.algorithms.earth_gravity import LOWEST_ORBIT_KM
from epipole.tasks.algorithms.geometry.directions import radec_from_unit, unit_from_radec
from epipole.tasks.algorithms.orbits.forces import Surroundings
from epipole.tasks.algorithms.orbits.orbit_fit import trajectory
from epipole.tasks.algorithms.orbits.reference_frames import (
    EME2000_FROM_GCRF,
    from_gcrf,
    orientation_at,
    state_rotation,
)
from epipole.tasks.algorithms.orbits.trajectories import propagate_unknowns
from epipole.tasks.common.orbit_forces import areas_in

# What is known of names.


def subjects(identifications: pl.DataFrame) -> dict[str, Subject]:
    """Return the objects and tracklets that have a name in a catalogue, by their ids."""
    known = identifications.filter(pl.col("status") == NameStatus.KNOWN.value)
    columns = [pl.coalesce("object_id", "tracklet_id"), "norad_id", "cospar_id", "name"]
    return {row[0]: Subject(*row) for row in known.select(columns).iter_rows()}


# Directions of one object or tracklet, and the ephemerides of the sensors.


def directions(observations: pl.DataFrame, ephemerides: Mapping[str, str]) -> dict[str, Directions]:
    """Return the directions of one object or tracklet by sensor, in the order of the names.

    Parameters
    ----------
    observations
        OBSERVATIONS of it, sorted by time.
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


def in_frame(of: Ephemeris, frame: str) -> Ephemeris:
    """Return an ephemeris in GCRF with its covariances in another of `MESSAGE_FRAMES`.

    All covariances are positive definite, as readers ask; see `positive`.
    """
    if frame == of.frame:
        return of._replace(covariance=positive(of.covariance))
    table = read_earth_orientation()
    turn, covariance_turn = (
        from_gcrf(frame, time_ns, orientation_at(time_ns, *table))
        for time_ns in (of.time_ns, of.covariance_ns)
    )
    state = np.einsum("nij,nj->ni", turn, of.state)
    covariance = covariance_turn @ of.covariance @ np.swapaxes(covariance_turn, 1, 2)
    return Ephemeris(of.time_ns, state, of.covariance_ns, positive(covariance), frame)


# Of a correlation matrix: a smaller eigenvalue is lost in the rounding of its elements.
LEAST_EIGENVALUE = 1e-10


def positive(covariance: np.ndarray) -> np.ndarray:
    """Return covariances (n, 6, 6) that rounding does not make indefinite.

    After a day, an orbit that a short arc hardly shows is known a million times better across than
    along its motion. Its variances become larger by up to 1e-10 of themselves.
    """
    symmetric = (covariance + np.swapaxes(covariance, 1, 2)) / 2
    sigma = np.sqrt(np.diagonal(symmetric, axis1=1, axis2=2))
    least = np.linalg.eigvalsh(symmetric / (sigma[:, :, None] * sigma[:, None, :]))[:, 0]
    more = np.clip(2 * LEAST_EIGENVALUE - least, 0.0, None) * (least < LEAST_EIGENVALUE)
    return np.asarray(symmetric + (more[:, None] * sigma**2)[:, :, None] * np.eye(6))


# The orbit of an object, moved through its arc under the forces that it was fitted with.

STEPS = 60  # of an arc, at least
MAX_STEP_S = 120.0  # between the states of an ephemeris: an interpolation is right to a millimetre


def single_orbit(orbit: Mapping[str, Any]) -> Ephemeris:
    """Return a row of ORBITS by itself, at its epoch."""
    time_ns = np.array([orbit["epoch_ns"]])
    state = np.array([[orbit[name] for name in (*POSITION, *VELOCITY)]])
    covariance = stack_covariance(pl.DataFrame([orbit]), "cov_{}", STATE_AXES)
    return Ephemeris(time_ns, state, time_ns, covariance)


def orbit_arc(
    orbit: Mapping[str, Any], around: Surroundings, origin_ns: int, ahead_s: float = 0.0
) -> Ephemeris:
    """Return the ephemeris of a row of ORBITS over its arc, with the covariance of each state.

    Parameters
    ----------
    around
        Counts from `origin_ns`.
    ahead_s
        How long after the arc it goes on; less where the object comes down before. The covariance
        is that of the fit, moved: errors of the forces are not in it.
    """
    half_s = max(orbit["arc_s"] / 2, 1.0)
    epoch_s = (orbit["epoch_ns"] - origin_ns) / SECOND_NS
    R = state_rotation(around.R_night_from_gcrf)
    of = single_orbit(orbit)
    start = np.concatenate([R @ of.state[0], areas_in(orbit["forces"])])
    found: list[tuple[float, np.ndarray, np.ndarray]] = []
    for end_s in (-half_s, half_s + ahead_s):
        unknowns, transition = start, np.eye(len(start))
        steps = max(STEPS // 2, int(np.ceil(abs(end_s) / MAX_STEP_S)))
        for k in range(1, steps + 1):
            before, at = (end_s * step / steps for step in (k - 1, k))
            unknowns, moved = propagate_unknowns(unknowns, epoch_s + before, epoch_s + at, around)
            if not np.linalg.norm(unknowns[:3]) > LOWEST_ORBIT_KM:
                break
            transition = moved @ transition
            turned = R.T @ transition[:6, :6] @ R
            found.append((at, R.T @ unknowns[:6], turned @ of.covariance[0] @ turned.T))
    found.append((0.0, of.state[0], of.covariance[0]))
    found.sort(key=lambda each: each[0])
    at_s, states, covariances = zip(*found, strict=True)
    time_ns = orbit["epoch_ns"] + np.rint(np.array(at_s) * SECOND_NS).astype(np.int64)
    return Ephemeris(time_ns, np.array(states), time_ns, np.array(covariances))


# Objects without an orbit: each state, moved through the arc that it was fitted to.

HALF_ARC_S = 300.0  # a state is of an arc of ten minutes at most
LEAST_HALF_ARC_S = 1.0


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

    It covers those of the object's POSITIONS that are nearest to the state's epoch, so that no two
    overlap: point mass and J2 from there, with the covariance of each state.
    """
    singles = single_states(states.unique("epoch", keep="first").sort("epoch"))
    epoch_ns = np.array([int(of.time_ns[0]) for of in singles], np.int64)
    seen_ns = positions["epoch"].dt.epoch("ns").to_numpy()
    nearest = np.searchsorted((epoch_ns[:-1] + epoch_ns[1:]) // 2, seen_ns)
    half_s = np.diff(epoch_ns) / SECOND_NS / 2  # to the middle between two states
    room_s = np.minimum(np.concatenate([[np.inf], half_s, [np.inf]]), LEAST_HALF_ARC_S)
    return [
        _arc(of, seen_ns[nearest == k], (-room_s[k], room_s[k + 1])) for k, of in enumerate(singles)
    ]


def _arc(of: Ephemeris, seen_ns: np.ndarray, least_s: tuple[float, float]) -> Ephemeris:
    """Return a state moved to the first and the last of these times, or to `least_s` about it."""
    epoch_ns = int(of.time_ns[0])
    since_s = (seen_ns - epoch_ns) / SECOND_NS
    inside = since_s[np.abs(since_s) <= HALF_ARC_S]
    first = min(inside.min(initial=0.0), least_s[0])
    last = max(inside.max(initial=0.0), least_s[1])
    step = (last - first) / STEPS
    later = np.linspace(0.0, last, int(np.ceil(last / step)) + 1)
    earlier = np.linspace(0.0, first, int(np.ceil(-first / step)) + 1)
    at_s = np.concatenate([later, earlier[1:]])  # outwards from the epoch: the fastest order
    state, transition = trajectory(of.state[0], at_s)
    order = np.argsort(at_s, kind="stable")
    time_ns = epoch_ns + np.rint(at_s * SECOND_NS).astype(np.int64)
    covariance = transition @ of.covariance[0] @ np.swapaxes(transition, 1, 2)
    return Ephemeris(time_ns[order], state[order], time_ns[order], covariance[order])

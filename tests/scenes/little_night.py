"""A little night by hand: two sensors, two objects, one star, and a dataset of it with errors."""

import math

from epipole.io.simulation.truth import Truth
from epipole.schemas.bridge import table
from epipole.schemas.tables import (
    ASSOCIATIONS,
    DETECTIONS,
    EPOCHS,
    FRAMES,
    IDENTIFICATIONS,
    OBSERVATIONS,
    ORBITS,
    POSITIONS,
    STARS,
    STATES,
    TRACKLETS,
)
from epipole.schemas.work_tables import TRUE_FRAMES, TRUE_POINTS

T0_NS = 1_554_091_200_000_000_000
SECOND_NS = 1_000_000_000
# Circular, in the equator, at its node: at (radius, 0, 0) at t0.
RADII_KM = (42164.0, 42000.0)
RINGS = [[radius, 0.0, 0.0, 0.0, 0.0, 0.0] for radius in RADII_KM]
SPEED_KM_S = (398600.4418 / RADII_KM[0]) ** 0.5
QUAT = {"qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}
STAR, OBJECT = 0, 1


def rows(schema, *values):
    """Return a table of these rows. A missing float is 0, the rest null or empty."""
    blank = {"double": 0.0, "int64": 0, "int32": 0, "string": "", "bool": True, "int8": 0}
    columns = {}
    for f in schema:
        default = T0_NS if "timestamp" in str(f.type) else blank[str(f.type)]
        columns[f.name] = [v.get(f.name, None if f.nullable else default) for v in values]
    return table(schema, columns)


def little_truth(n_frames: int = 1) -> Truth:
    """Two sensors with a frame per second, each of which shows star 77 and two objects."""
    frames = [
        {"sensor_id": s, "frame_number": i, "t_ns": T0_NS + i * SECOND_NS, **QUAT}
        for s in ("a", "b")
        for i in range(n_frames)
    ]
    shown = [(STAR, 77), (OBJECT, 0), (OBJECT, 1)]
    points = [
        {
            "sensor_id": s,
            "frame_number": i,
            "centroid": k,
            "kind": kind,
            "source": source,
            "magnitude": 8.0,
        }
        for s in ("a", "b")
        for i in range(n_frames)
        for k, (kind, source) in enumerate(shown)
    ]
    targets = [{"elements": e} for e in RINGS]
    scenario = {"t0_ns": T0_NS, "sensors": [{"rate_hz": 1.0}] * 2, "targets": targets}
    return Truth(rows(TRUE_FRAMES, *frames), rows(TRUE_POINTS, *points), scenario)


def little_dataset():
    """Object 0 right, 1 km and one sigma off; a ghost of object 1 and a star; one star wrong.

    Two observations: one is a sigma off, its magnitude two; the other shows a star.
    """
    half = {"qx": 5e-5, "qw": 1.0}  # a turn by 1e-4 rad about x
    frames = [{"sensor_id": s, "attitude_source": "stars", **QUAT, **half} for s in "ab"]
    stars = [{"sensor_id": "a", "star_id": 77}, {"sensor_id": "b", "star_id": 78}]
    views = [("o1", "a", 1), ("o1", "b", 1), ("o2", "a", 2), ("o2", "b", 0), ("o2", "b", 2)]
    associations = [
        {"object_id": o, "sensor_id": s, "centroid": k, "used": i < 4}
        for i, (o, s, k) in enumerate(views)
    ]
    cov = {"cov_xx": 1.0, "cov_yy": 4.0, "cov_zz": 9.0}
    positions = [{"object_id": "o1", "x_km": 42165.0, **cov}, {"object_id": "o2", **cov}]
    tracked = {"kind": "object", "track_id": "a1", "tracklet_id": "a1"}
    detections = [{"sensor_id": "a", "centroid": k, **tracked} for k in (1, 2, 0)]
    # Where its light left, object 0 stands behind by its speed over that of light.
    seen = {"ra_deg": -math.degrees(SPEED_KM_S / 299792.458), "dec_deg": 1 / 3600}
    sigma = {"sigma_ra_arcsec": 1.0, "sigma_dec_arcsec": 1.0}
    bright = {"magnitude": 8.1, "magnitude_sigma": 0.05}
    observations = [
        {"object_id": "o1", "sensor_id": s, "centroid": k, **seen, **sigma, **bright}
        for s, k in (("a", 1), ("b", 0))
    ]
    return {
        "frames": rows(FRAMES, *frames),
        "stars": rows(STARS, *stars),
        "detections": rows(DETECTIONS, *detections),
        "tracklets": rows(TRACKLETS),
        "epochs": rows(EPOCHS, {"sensor_id": "a"}, {"sensor_id": "b"}),
        "associations": rows(ASSOCIATIONS, *associations),
        "positions": rows(POSITIONS, *positions),
        "observations": rows(OBSERVATIONS, *observations),
        "states": rows(STATES, little_state("o1", x_km=1.0), little_state("o2")),
        "orbits": rows(ORBITS, little_state("o1", x_km=0.5, forces="GM"), little_state("o3")),
        "identifications": rows(IDENTIFICATIONS),
    }


def little_state(object_id, x_km=0.0, vy_km_s=0.0, **other):
    """Return a state of object 0 at t0, this far off, with 1-sigma of 0.5 km and 0.01 km/s."""
    variances = {f"cov_{a}{a}": 0.5**2 for a in "xyz"}
    variances |= {f"cov_v{a}v{a}": 0.01**2 for a in "xyz"}
    place = {"x_km": RADII_KM[0] + x_km, "vy_km_s": SPEED_KM_S + vy_km_s}
    return {"object_id": object_id, **variances, **place, **other}

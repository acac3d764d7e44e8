"""Scenes of tracklets as tables, the input of the association stage, and its results."""

import numpy as np
import pyarrow as pa

from epipole.schemas.settings import AssociationSettings, Settings
from epipole.schemas.tables import TRACKLETS
from epipole.schemas.work_tables import CAMERAS, SOLUTIONS, VIEWS
from epipole.tasks.algorithms.geometry.rotations import quaternion_from_matrix
from epipole.tasks.solve.association.associate_objects import associate_objects
from scenes.tracklet_scenes import Scene

START_NS = int(np.datetime64("2019-04-01T04:00:00", "ns").astype(np.int64))
WIDTH = 512


def filled(schema: pa.Schema, n: int, columns: dict) -> pa.Table:
    """Return a table with these columns; the others are null if nullable, else 0 or empty."""
    arrays = []
    for field in schema:
        if field.name in columns:
            arrays.append(pa.array(columns[field.name], from_pandas=False).cast(field.type))
        elif field.nullable:
            arrays.append(pa.nulls(n, field.type))
        elif pa.types.is_string(field.type):
            arrays.append(pa.array([""] * n, field.type))
        else:
            arrays.append(pa.array(np.zeros(n, np.int64)).cast(field.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def tables(scene: Scene, names=None) -> tuple[pa.Table, pa.Table, pa.Table, pa.Table]:
    """Return the input tables of the stage: views, tracklets, solutions, cameras."""
    samples = scene.samples()
    n_sensors, k = samples.sensor_km.shape[:2]
    names = np.array(names or [f"sat{s}" for s in range(n_sensors)])
    epoch = START_NS + np.round(scene.times * 1e9).astype(np.int64)
    item, at = np.nonzero(samples.seen)
    s, u = samples.sensor[item], samples.u[item, at]
    cov, n = samples.cov[item, at], len(item)
    focal = WIDTH / 2 / samples.half_field[0, 0]
    views = filled(VIEWS, n, {
        "epoch": epoch[at], "sensor_id": names[s], "frame_number": at,
        "tracklet_id": [f"t{i:04d}" for i in item], "centroid": item.astype(np.int32),
        "ux": u[:, 0], "uy": u[:, 1], "uz": u[:, 2],
        **{f"w{a}_rad_s": np.zeros(n) for a in "xyz"},
        "cov_noise_11_rad2": cov[:, 0, 0], "cov_noise_12_rad2": cov[:, 0, 1],
        "cov_noise_22_rad2": cov[:, 1, 1], "cov_bias_11_rad2": np.zeros(n),
        "cov_bias_12_rad2": np.zeros(n), "cov_bias_22_rad2": np.zeros(n),
        **{f"{a}_km": samples.sensor_km[s, at, i] for i, a in enumerate("xyz")},
        "position_sigma_km": samples.sigma_km[item, at], "pixel_rad": np.full(n, 1 / focal),
        "x_px": np.zeros(n), "y_px": np.zeros(n),
    })  # fmt: skip
    t = len(samples.sensor)
    ids = [f"t{i:04d}" for i in range(t)]
    tracklets = filled(TRACKLETS, t, {
        "tracklet_id": ids, "track_id": ids, "sensor_id": names[samples.sensor],
        "start_time": START_NS + np.round(samples.start_s * 1e9).astype(np.int64),
        "end_time": START_NS + np.round(samples.end_s * 1e9).astype(np.int64),
    })  # fmt: skip
    m = n_sensors * k
    q = quaternion_from_matrix(samples.R_sensor_from_icrs.reshape(m, 3, 3))
    r = samples.sensor_km.reshape(m, 3)
    solutions = filled(SOLUTIONS, m, {
        "sensor_id": np.repeat(names, k), "frame_number": np.tile(np.arange(k), n_sensors),
        "time": np.tile(epoch, n_sensors), "attitude_source": ["stars"] * m,
        **{f"q{a}": q[:, i] for i, a in enumerate("xyzw")},
        **{f"{a}_km": r[:, i] for i, a in enumerate("xyz")},
        **{f"v{a}_km_s": np.zeros(m) for a in "xyz"},
        **{f"cov_att_{ab}_arcsec2": np.full(m, 1.0 if ab[0] == ab[1] else 0.0)
           for ab in ("xx", "xy", "xz", "yy", "yz", "zz")},
        "used_position_sigma_km": np.full(m, 0.02),
    })  # fmt: skip
    cameras = filled(CAMERAS, 1, {
        "sensor_id": [names[0]], "time": [START_NS], "width": [WIDTH], "height": [WIDTH],
        "fx_px": [focal], "fy_px": [focal], "cx_px": [255.5], "cy_px": [255.5],
    })  # fmt: skip
    return views, tracklets, solutions, cameras


def associated(scene: Scene, **changes):
    settings = Settings(association=AssociationSettings(**changes))
    return associate_objects(*tables(scene), settings)


def reasons(found) -> dict[str, int]:
    rejects = found.rejects.to_pylist()
    return {
        r["reason"]: sum(x["count"] for x in rejects if x["reason"] == r["reason"]) for r in rejects
    }


def wrong_views(scene: Scene, found) -> int:
    """Return how many objects have views of different true objects, or of none."""
    who = np.array([scene.who[int(t[1:])] for t in found.views["tracklet_id"].to_pylist()])
    wrong = 0
    for k in np.unique(found.object_number):
        true = who[found.object_number == k]
        wrong += int((true != true[0]).any() or true[0] < 0)
    return wrong

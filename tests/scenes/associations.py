"""Scenes of tracklets as tables, the input of the association stage, and its results."""

import tempfile
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.work.parts import VIEWED, Parts, write_part
from epipole.schemas.bridge import array, empty
from epipole.schemas.settings import AssociationSettings, Settings
from epipole.schemas.spans import SPAN_NS, Span
from epipole.schemas.work_tables import (
    ATTRIBUTABLES,
    CAMERAS,
    SIGHTINGS,
    SOLUTIONS,
    TRACKLET_RUNS,
    VIEWS,
)
from epipole.tasks.algorithms.geometry.directions import quaternion_from_matrix
from epipole.tasks.solve.align_epochs import EpochGrid, align_epochs
from epipole.tasks.solve.associate_block import blocks_of, object_members
from epipole.tasks.solve.associate_objects import associate_objects
from epipole.tasks.solve.association_input import BlockViews, SensorViews
from epipole.tasks.solve.solve_piece import gather_views
from epipole.tasks.solve.views import sensor_epochs, viewed_tracklets
from scenes.tracklet_scenes import Scene

START_NS = int(np.datetime64("2019-04-01T04:00:00", "ns").astype(np.int64))
SPAN = Span(START_NS, START_NS + SPAN_NS)
WIDTH = 512


class SceneTables(NamedTuple):
    """What the association is made from: VIEWS, TRACKLET_RUNS, SOLUTIONS, CAMERAS."""

    views: pa.Table
    tracklets: pa.Table
    solutions: pa.Table
    cameras: pa.Table


class Found(NamedTuple):
    """The views of objects, the number of the object of each, and rows of `rejects`."""

    views: pa.Table
    object_number: np.ndarray
    rejects: pa.Table


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
        elif pa.types.is_list(field.type):
            arrays.append(pa.array([[]] * n, field.type))
        else:
            arrays.append(pa.array(np.zeros(n, np.int64)).cast(field.type))
    return pa.Table.from_arrays(arrays, schema=schema)


def tables(scene: Scene, names=None) -> SceneTables:
    """Return the tables of a scene; sensors may have names."""
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
    tracklets = filled(TRACKLET_RUNS, t, {
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
    cameras = filled(CAMERAS, n_sensors, {
        "sensor_id": names, "time": [START_NS] * n_sensors,
        **{name: [WIDTH] * n_sensors for name in ("width", "height")},
        **{name: [focal] * n_sensors for name in ("fx_px", "fy_px")},
        **{name: [255.5] * n_sensors for name in ("cx_px", "cy_px")},
    })  # fmt: skip
    return SceneTables(views, tracklets, solutions, cameras)


def _same(rows: pa.Table) -> pa.Table:
    return rows


def sensor_views(of: SceneTables, settings: Settings | None = None) -> list[SensorViews]:
    """Return the views of each sensor, in the order of the ids, as the part of a span has them."""
    instants = np.union1d(array(of.solutions, "time"), array(of.views, "epoch"))
    step_ns = int(np.diff(instants).min()) if len(instants) > 1 else 1_000_000_000
    grid = EpochGrid(step_ns, tuple(instants.tolist()))
    out = []
    for number, name in enumerate(sorted(set(of.solutions["sensor_id"].to_pylist()))):
        of_sensor = pc.field("sensor_id") == name
        solutions = of.solutions.filter(of_sensor)
        views = of.views.filter(of_sensor).sort_by(
            [("tracklet_id", "ascending"), ("epoch", "ascending")]
        )
        epochs = align_epochs(solutions, (settings or Settings()).alignment, grid)
        tracklets = viewed_tracklets(of.tracklets.filter(of_sensor), views)
        out.append(
            SensorViews(
                number, name, partial(_same, views), sensor_epochs(epochs, solutions), tracklets
            )
        )
    return out


def block_of(of: SceneTables, settings: Settings | None = None) -> BlockViews:
    """Return the views of a scene, which lies in one block."""
    settings = settings or Settings()
    block = blocks_of(SPAN, settings.association)[0]
    assert block.holds(array(of.views, "epoch")).all()
    window_s, half_width_s = settings.association.window_s, settings.alignment.window_s
    return BlockViews(sensor_views(of, settings), of.cameras, block, window_s, half_width_s)


def write_views(folder: Path, sensors: Sequence[SensorViews], span: Span) -> Mapping[int, Parts]:
    """Write the parts of the views of sensors in a span, and return them by sensor number."""
    viewed = {of.number: Parts(folder / str(of.number)) for of in sensors}
    for of in sensors:
        tables = {"views": of.read_views(), "epochs": of.epochs, "tracklets": of.tracklets}
        tables |= {"sightings": empty(SIGHTINGS), "attributables": empty(ATTRIBUTABLES)}
        write_part(viewed[of.number].of(span), VIEWED, tables)
    return viewed


def associated(scene: Scene, names=None, **changes) -> Found:
    """Return the objects of a scene, with the views that positions are solved from."""
    settings = Settings(association=AssociationSettings(**changes))
    block = block_of(tables(scene, names), settings)
    found = associate_objects(block, settings.association, settings.work.max_views)
    members = object_members(block, found)
    with tempfile.TemporaryDirectory() as folder:
        viewed = write_views(Path(folder), block.sensors, SPAN)
        views, number = gather_views(viewed, members, SPAN)
    return Found(views, number, found.rejects)


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

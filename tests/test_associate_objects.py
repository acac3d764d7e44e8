"""The stage that associates: good views become objects, bad ones a reason and no position."""

import numpy as np
import pyarrow as pa
import pytest
from test_association import Scene

from epipole.schemas.settings import AssociationSettings, Settings
from epipole.schemas.tables import TRACKLETS
from epipole.schemas.work_tables import CAMERAS, SOLUTIONS, VIEWS
from epipole.tasks.algorithms.rotations import quaternion_from_matrix
from epipole.tasks.associate_objects import associate_objects

START_NS = int(np.datetime64("2019-04-01T04:00:00", "ns").astype(np.int64))
WIDTH = 512


def filled(schema: pa.Schema, n: int, columns: dict) -> pa.Table:
    """A table with these columns; the others are null where they may be, else 0 or empty."""
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
    """The scene as the stage gets it: views, tracklets, solutions, cameras."""
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
        "position_sigma_km": np.full(m, 0.02),
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
    """Views that share an object's number with a view of something else."""
    who = np.array([scene.who[int(t[1:])] for t in found.views["tracklet_id"].to_pylist()])
    wrong = 0
    for k in np.unique(found.object_number):
        own = who[found.object_number == k]
        wrong += int((own != own[0]).any() or own[0] < 0)
    return wrong


@pytest.mark.parametrize("method", ["likelihood", "epipolar"])
def test_objects_come_out_with_all_their_views(method):
    # Far apart against 8 px, so that the published method can tell them.
    scene = Scene(11, 4).objects(4, spread_km=300.0)
    found = associated(scene, method=method)
    assert wrong_views(scene, found) == 0
    assert len(np.unique(found.object_number)) == 4
    assert found.views.num_rows >= 0.9 * 4 * 4 * len(scene.times)


def test_it_is_the_same_bit_for_bit():
    one, other = (associated(Scene(12, 5).objects(10).strays(30)) for _ in range(2))
    assert one.views.equals(other.views)
    assert one.rejects.equals(other.rejects)
    assert (one.object_number == other.object_number).all()


def test_one_sensor_alone_gives_no_object():
    found = associated(Scene(13, 1).objects(5))
    assert found.views.num_rows == 0


def test_parallel_lines_of_sight_give_no_object():
    scene = Scene(14, 2)
    scene.r[1] = scene.r[0] + [0.05, 0.0, 0.0]  # side by side
    assert associated(scene.objects(3)).views.num_rows == 0


def test_an_object_behind_a_sensor_gives_no_object():
    scene = Scene(15, 3)
    for s in range(3):
        away = scene.r[s] - np.array([42164.0, 0.0, 0.0])
        scene.add(s, 0, away / np.linalg.norm(away, axis=1, keepdims=True))
    assert associated(scene).views.num_rows == 0


def test_an_object_inside_the_earth_gives_no_object():
    scene = Scene(16, 3)
    for s in range(3):
        inward = np.array([4000.0, 0.0, 0.0]) - scene.r[s]
        scene.add(s, 0, inward / np.linalg.norm(inward, axis=1, keepdims=True))
    assert associated(scene).views.num_rows == 0


@pytest.mark.parametrize("error", ["attitude", "state", "clock"])
def test_a_wrong_sensor_is_left_out_named_and_spoils_nothing(error, caplog):
    scene = Scene(17, 4).objects(8, spread_km=100.0)
    if error == "attitude":  # by a degree, and it is believed to be turned so
        axis = np.array([0.0, 0.0, 1.0])
        for i, s in enumerate(scene.sensor):
            if s == 3:
                u = scene.u[i] + np.cross(axis, scene.u[i]) * np.radians(1.0)
                scene.u[i] = u / np.linalg.norm(u, axis=1, keepdims=True)
    else:  # a state a minute old, or a clock a second off: it is not where it is said to be
        v = np.gradient(scene.r[3], scene.times, axis=0)
        scene.r[3] += v * (60.0 if error == "state" else 4.0)
    found = associated(scene)
    assert wrong_views(scene, found) == 0
    assert "sat3" not in found.views["sensor_id"].to_pylist()
    assert len(np.unique(found.object_number)) == 8
    if error != "attitude":  # turned so far that nothing of the others' stands in its field
        assert reasons(found).get("sensor_disagrees", 0) >= 8
        assert "sat3" in caplog.text


def test_a_clock_a_second_off_gives_no_wrong_object():
    scene = Scene(18, 4).objects(8, spread_km=100.0)
    scene.r[3] += np.gradient(scene.r[3], scene.times, axis=0) * 1.0
    assert wrong_views(scene, associated(scene)) == 0


def test_two_sensors_with_one_id_give_no_wrong_object():
    scene = Scene(19, 4).objects(6, spread_km=100.0)
    settings = Settings()
    found = associate_objects(*tables(scene, ["sat0", "sat1", "sat2", "sat2"]), settings)
    assert wrong_views(scene, found) == 0


def test_what_cannot_be_decided_is_called_ambiguous():
    scene = Scene(3, 2, times=np.array([0.0]))
    baseline = scene.r[1, 0] - scene.r[0, 0]
    towards = np.array([-39359.89, 15125.76, 64.30]) - scene.r[0, 0]
    towards /= np.linalg.norm(towards)
    across = baseline - (baseline @ towards) * towards
    across /= np.linalg.norm(across)
    middle = np.array([-39359.89, 15125.76, 64.30])
    for k, off in enumerate((-2.0, 2.0)):
        for s in range(2):
            path = middle + off * across - scene.r[s]
            scene.add(s, k, path / np.linalg.norm(path, axis=1, keepdims=True))
    found = associated(scene)
    assert found.views.num_rows == 0
    assert reasons(found) == {"ambiguous": 4}

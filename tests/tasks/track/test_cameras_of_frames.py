"""Tracklets by the camera of each frame, and by the angle of a pixel where the detection is."""

import numpy as np
import pyarrow as pa
import pytest
from scenes.cameras import cameras_of
from scenes.identified import tracked
from scipy.spatial.transform import Rotation

from epipole.schemas.bridge import array, table
from epipole.schemas.columns import TIME
from epipole.schemas.settings import Settings
from epipole.schemas.tables import DETECTIONS
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.geometry.camera import Camera, pixel_angle, project, unproject
from epipole.tasks.algorithms.geometry.directions import radec_from_unit
from epipole.tasks.algorithms.orbits.planets import planet_directions

N = 60
T_S = np.arange(float(N))
FULL = Camera(1024, 1024, 5000.0, 5000.0, 511.5, 511.5)
BINNED = Camera(512, 512, 2500.0, 2500.0, 255.5, 255.5)
CROPPED = FULL._replace(width=256, height=256, cx_px=127.5, cy_px=127.5)


def filled(schema, **given):
    """Return a table of a frame a second; other columns are null, or else 0 or empty."""
    key = {"sensor_id": ["a"] * N, "frame_number": np.arange(N), "time": (T_S * 1e9).astype(int)}
    for field in schema:
        if field.name not in given | key:
            kind = pa.int64() if field.type == TIME else field.type
            value = None if field.nullable else "" if field.type == pa.string() else 0
            given[field.name] = pa.array([value] * N, kind).cast(field.type)
    return table(schema, given | key)


def cameras(*optics):
    """Return CAMERAS of one sensor, one after the other."""
    rows = cameras_of({f"{k}": camera for k, camera in enumerate(optics)})
    at = rows.schema.get_field_index("sensor_id")
    return rows.set_column(at, rows.schema.field(at), pa.array(["a"] * len(optics)))


def seen(optics, of, xy_px, sigma_px, source="stars", q=None):
    """Return SOLUTIONS and DETECTIONS of a detection in each frame, whose camera is `of`."""
    u, sigma = np.empty((N, 3)), np.empty(N)
    for k, camera in enumerate(optics):
        u[of == k] = unproject(camera, *xy_px[:, of == k])
        sigma[of == k] = sigma_px * pixel_angle(camera, u[of == k]) / ARCSEC
    q = np.tile([0.0, 0.0, 0.0, 1.0], (N, 1)) if q is None else q
    ra, dec = np.degrees(radec_from_unit(Rotation.from_quat(q).inv().apply(u)))
    axes = ("xx", "xy", "xz", "yy", "yz", "zz")
    solutions = filled(
        SOLUTIONS, attitude_source=[source] * N, camera=of,
        **{f"q{axis}": q[:, k] for k, axis in enumerate("xyzw")},
        **{f"cov_att_{ab}_arcsec2": np.full(N, float(ab[0] == ab[1])) for ab in axes},
    )  # fmt: skip
    direction = {} if source == "none" else {"ra_deg": ra, "dec_deg": dec}
    return solutions, filled(
        DETECTIONS, x_px=xy_px[0], y_px=xy_px[1], sigma_arcsec=sigma, kind=["unknown"] * N,
        **direction,
    )  # fmt: skip


@pytest.mark.parametrize("source", ["stars", "none"])
def test_an_object_is_followed_where_the_calibration_changes(source):
    optics, of = (FULL, BINNED), (T_S >= 30).astype(int)
    u = np.column_stack([-0.05 + 0.001 * T_S, 0.02 + 0.0003 * T_S, np.ones(N)])
    xy_px = np.array([project((FULL, BINNED)[k], u[i : i + 1]) for i, k in enumerate(of)])[..., 0].T
    xy_px = xy_px + np.random.default_rng(1).normal(0, 0.1, (2, N))
    built = tracked(*seen(optics, of, xy_px, 0.1, source), cameras(*optics), Settings())
    assert array(built.tracklets, "n_detections").tolist() == [N]
    assert array(built.tracklets, "rate_arcsec_s") == pytest.approx(215.1, abs=0.3)
    assert array(built.tracklets, "residual_px") == pytest.approx(0.08, abs=0.02)


def test_a_hot_pixel_far_off_the_boresight_is_judged_as_one_near_it():
    kinds = {}
    for where, at_px in (("middle", (511.0, 300.0)), ("corner", (1000.0, 990.0))):
        wide = Camera(1024, 1024, 512.0, 512.0, 511.5, 511.5)  # 90 degrees
        q = Rotation.from_rotvec(np.outer(T_S, [0.0, 6e-4, 0.0])).as_quat()
        for seed in range(3):
            noise = np.random.default_rng(seed).normal(0, 0.03, (2, N))
            rows = seen([wide], np.zeros(N, int), np.array([at_px]).T + noise, 0.3, q=q)
            built = tracked(*rows, cameras(wide), Settings())
            kinds.setdefault(where, set()).update(built.detections["kind"].to_pylist())
    assert kinds == {"middle": {"hot_pixel"}, "corner": {"hot_pixel"}}


def test_a_planet_that_only_the_wider_of_two_cameras_sees_is_one():
    optics, of = (CROPPED, FULL), (T_S >= 30).astype(int)
    u, _ = planet_directions((T_S * 1e9).astype(np.int64), np.zeros((N, 3)), np.zeros((N, 3)))
    jupiter = u[:, 3]
    off = np.array([400.0 / 5000.0, 0.0, 1.0])  # inside FULL, outside CROPPED
    turn, _ = Rotation.align_vectors(np.array([off / np.linalg.norm(off)]), jupiter[:1])
    q = np.tile(turn.as_quat(), (N, 1))
    xy_px = np.array(project(FULL, turn.apply(jupiter)))
    built = tracked(*seen(optics, of, xy_px, 0.1, q=q), cameras(*optics), Settings())
    assert set(built.detections["kind"].to_pylist()[30:]) == {"planet"}

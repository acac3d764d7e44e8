"""Measure runs: a drift slower than any orbit's apparent motion is a star's."""

import numpy as np
import pyarrow as pa
import pytest
from scenes.cameras import cameras_of

from epipole.schemas.bridge import table
from epipole.schemas.columns import TIME
from epipole.schemas.settings import Settings
from epipole.schemas.tables import DETECTIONS
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.track.build_tracklets import build_tracklets

N = 600
TIME_NS = (np.arange(N) * 1e9).astype(np.int64)
CAMERA = {"width": 1024, "height": 1024, "fx_px": 9770.0, "fy_px": 9770.0, "cx_px": 511.5}
CAMERA |= {"cy_px": 511.5, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}


def filled(schema, n, **given):
    """Return a table of `n` rows; other columns are null, or else 0 or empty."""
    for field in schema:
        if field.name not in given:
            empty = "" if field.type == pa.string() else 0
            value = None if field.nullable else empty
            kind = pa.int64() if field.type == TIME else field.type
            given[field.name] = pa.array([value] * n, kind).cast(field.type)
    return table(schema, given)


def kinds(rate_arcsec_s):
    """Return the kinds of the detections of a point that moves at this rate for ten minutes."""
    rng = np.random.default_rng(1)
    key = {"sensor_id": ["a"] * N, "frame_number": np.arange(N), "time": TIME_NS}
    solutions = filled(
        SOLUTIONS, N, **key, attitude_source=["stars"] * N,
        qx=np.zeros(N), qy=np.zeros(N), qz=np.zeros(N), qw=np.ones(N),
        **{f"cov_att_{ab}_arcsec2": np.full(N, 1.0 if ab in ("xx", "yy", "zz") else 0.0)
           for ab in ("xx", "xy", "xz", "yy", "yz", "zz")},
    )  # fmt: skip
    off = 600.0 + rate_arcsec_s * np.arange(N) + rng.normal(0, 3.0, N)
    detections = filled(
        DETECTIONS, N, **key, ra_deg=30 + rng.normal(0, 3.0, N) / 600.0 * 57.3,
        dec_deg=90.0 - off / 3600, sigma_arcsec=np.full(N, 3.0), kind=["unknown"] * N,
        x_px=500 + off / 21.1, y_px=np.full(N, 300.3) + rng.normal(0, 0.14, N),
    )  # fmt: skip
    cameras = cameras_of({"a": Camera(**CAMERA)})
    built = build_tracklets(solutions, detections, cameras, Settings())
    return built.detections["kind"].to_pylist()


@pytest.mark.parametrize(
    ("rate_arcsec_s", "kind"), [(0.0, "star_unlisted"), (0.02, "star_unlisted"), (0.5, "object")]
)
def test_a_slow_drift_is_a_stars_and_a_faster_one_an_objects(rate_arcsec_s, kind):
    assert kinds(rate_arcsec_s).count(kind) > 0.98 * N

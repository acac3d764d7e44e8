"""Judge image sizes: centroids of a small log outside the image that is told, and a whole run."""

import logging

import numpy as np
import pytest
from scenes.altered_logs import altered
from scenes.cameras import cameras_of
from scenes.simulated import scene_of

from epipole.flows.nightly import nightly
from epipole.flows.simulate import simulate
from epipole.schemas.bridge import table
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.settings import Settings
from epipole.schemas.spans import SPAN_NS, Sensor, Span
from epipole.schemas.work_tables import EXPOSURES
from epipole.tasks.algorithms.geometry.camera import Camera
from epipole.tasks.identify import judge_image_sizes
from epipole.tasks.identify.identify_span import Counts
from epipole.tasks.identify.judge_image_sizes import OutsideImage, judge_image_size

TOLD = Camera(1024, 2048, 9000.0, 9000.0, 511.5, 1023.5)
SENSOR, SPANS = Sensor(0, "cam1"), [Span(k * SPAN_NS, (k + 1) * SPAN_NS) for k in (2, 3)]


class Frames:
    """Ten frames of a sensor of this image, the first of them without a centroid outside."""

    def __init__(self, width, height, told=TOLD):
        rng = np.random.default_rng(1)
        x, y = rng.uniform(-0.5, width - 0.5, (10, 40)), rng.uniform(-0.5, height - 0.5, (10, 40))
        x[0], y[0] = 5.0, 5.0
        self.out = (x > told.width - 0.5) | (y > told.height - 0.5)
        n = 10
        self.time_ns = SPANS[1].start_ns + np.arange(n) * 10**9
        key = {"sensor_id": ["cam1"] * n, "frame_number": np.arange(n), "time": self.time_ns}
        rest = {"exposure_s": [0.1] * n, "source": ["a.mcap"] * n, "offset": [None] * n}
        lists = {"x_px": list(x), "y_px": list(y), "flux": [None] * n, "sigma_px": [None] * n}
        self.exposures = table(EXPOSURES, key | rest | lists)
        self.cameras = cameras_of({"cam1": told})
        self.asked = []

    def between(self, folder, sensor, start_ns, end_ns):
        self.asked.append((start_ns, end_ns))
        at = np.flatnonzero((self.time_ns >= start_ns) & (self.time_ns < end_ns))
        return self.exposures.take(at)

    def read(self, span, name, columns):
        """Stand in for the parts of the span in which the frames are."""
        assert span == SPANS[1]
        whole = {"solutions": self.exposures, "rejects": self.rejects()}
        return whole[name].select(columns)

    def rejects(self):
        first = self.time_ns[self.out.any(axis=1)][:1]
        count = [int(self.out.sum())] * len(first)
        return reject_rows(Reason.OUTSIDE_IMAGE, time=first, count=count, sensor_id="cam1")

    def judged(self, monkeypatch, inside=0):
        monkeypatch.setattr(judge_image_sizes, "frames_between", self.between)
        counts = [Counts(inside, 0, 0, inside, 0), Counts(10, 0, 0, 400, int(self.out.sum()))]
        return judge_image_size(
            None, SENSOR, self, list(zip(SPANS, counts, strict=True)), self.cameras, Settings()
        )


def test_an_image_with_width_and_height_exchanged_is_named_so(monkeypatch):
    frames = Frames(2048, 1024)
    share = frames.out.mean()
    assert 0.4 < share < 0.5
    found = frames.judged(monkeypatch)
    assert found == OutsideImage("cam1", share, 1024, 2048, exchanged=True)
    assert str(found) == (
        f"cam1: {100 * share:.0f} % of its centroids lie outside the image of 1024 x 2048 px that "
        "its calibration tells (width and height exchanged?)"
    )


@pytest.mark.parametrize("size", [(1500, 3000), (4096, 1024), (1024, 4096)])
def test_an_image_that_is_larger_otherwise_has_no_hint(monkeypatch, size):
    assert str(Frames(*size).judged(monkeypatch)).endswith("that its calibration tells")


def test_a_square_image_has_no_hint(monkeypatch):
    found = Frames(2048, 1024, told=TOLD._replace(height=1024)).judged(monkeypatch)
    assert not found.exchanged


def test_few_centroids_outside_are_not_said_and_no_frame_is_read(monkeypatch):
    frames = Frames(2048, 1024)
    assert frames.judged(monkeypatch, inside=4_000) is None
    assert Frames(1024, 2048).judged(monkeypatch) is None
    assert frames.asked == []


def test_frames_are_read_from_the_first_with_centroids_outside_and_not_all(monkeypatch):
    frames = Frames(2048, 1024)
    monkeypatch.setattr(judge_image_sizes, "LOOKED_AT", 3)
    assert frames.judged(monkeypatch).exchanged
    start_ns = SPANS[1].start_ns + 10**9
    assert frames.asked == [(start_ns, start_ns + 2 * 10**9 + 1)]


@pytest.mark.usefixtures("prefect")
@pytest.mark.parametrize("exchanged", [True, False])
def test_a_run_says_that_width_and_height_are_exchanged(tmp_path, caplog, exchanged):
    camera = {"fov_deg": 12.0, "width": 1024, "height": 512}
    log = simulate(scene_of({"camera": camera}), tmp_path / "n.mcap", seed=3).logs[0]
    turned = {"width": 512, "height": 1024} if exchanged else {}
    log = altered(log, tmp_path / "t.mcap", camera=lambda row: turned)
    settings = Settings.model_validate({"identification": {"calibrate": "off"}})
    with caplog.at_level(logging.WARNING):
        nightly([str(log)], str(tmp_path / "out"), settings)
    said = [r.getMessage() for r in caplog.records if "lie outside the image" in r.getMessage()]
    assert len(said) == exchanged
    for line in said:
        assert line.endswith("of 512 x 1024 px that its calibration tells (width and height "
                             "exchanged?)")  # fmt: skip

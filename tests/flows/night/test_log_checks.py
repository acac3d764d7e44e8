"""The checks of a night's logs: what they take from the logs of each sensor."""

import pytest

from epipole.flows.night.log_checks import _exposure_s
from epipole.io.logs.writer import LogWriter
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.settings import Settings
from epipole.tasks.read.order_frames import order_logs
from epipole.tasks.read.read_logs import read_log_into

START_NS = 1_554_091_200_000_000_000


@pytest.fixture
def frames(tmp_path):
    """Return the frames of one log with two sensors: short exposures are more frequent."""
    with LogWriter(tmp_path / "a.mcap") as log:
        for sensor, exposure_s, n in (("long", 1.0, 3), ("short", 0.1, 9)):
            for k in range(n):
                log.frame(
                    sensor, START_NS + k * 1_000_000_000, frame_number=k, exposure_s=exposure_s,
                    x_px=[1.0], y_px=[2.0],
                )  # fmt: skip
    folder = ReadFolder(tmp_path)
    return order_logs(
        folder, [read_log_into(folder, 0, str(tmp_path / "a.mcap"))], Settings().sensors
    )


def test_exposures_are_those_of_the_sensor_and_not_of_others_in_its_log(frames):
    exposure_s = {name: _exposure_s(frames, k) for k, name in enumerate(frames.sensors)}
    assert exposure_s == {"long": 1.0, "short": 0.1}

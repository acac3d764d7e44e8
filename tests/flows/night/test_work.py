"""The spans of a night: its own and one before and after; none without a calibration."""

from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from epipole.flows.night import work
from epipole.flows.night.work import Work, cameras_of_night, count_frames, plan_spans
from epipole.io.work.work_layout import ReadFolder, WorkFolder
from epipole.schemas.bridge import array, empty
from epipole.schemas.columns import TIME
from epipole.schemas.errors import LogError
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.spans import DAY_NS, SPAN_NS
from epipole.schemas.tables import REJECTS
from epipole.schemas.work_tables import CAMERAS, LogSource
from epipole.tasks.read.order_frames import OrderedFrames, by_span

NIGHT = "2019-04-02"
MIDNIGHT_NS = int(np.datetime64(NIGHT, "ns").astype(np.int64))


def cameras(*sensors: str) -> pa.Table:
    blank = {f.name: False if pa.types.is_boolean(f.type) else 0 for f in CAMERAS}
    return pa.Table.from_pylist([blank | {"sensor_id": name} for name in sensors], schema=CAMERAS)


def frames(calibrated: list[str], **hours: list[float]) -> OrderedFrames:
    """Frames of sensors, by hours from midnight."""
    time_ns = [MIDNIGHT_NS + (np.array(own) * 3600e9).astype(np.int64) for own in hours.values()]
    spans = [by_span(each) for each in time_ns]
    sources = [LogSource("log.mcap", 1, "0", 0, 1)]
    folder = ReadFolder(Path("/nowhere"))
    return OrderedFrames(
        folder, list(hours), spans, cameras(*calibrated), sources, empty(REJECTS), [[]] * len(hours)
    )


def test_a_night_has_one_more_span_before_and_after():
    found = frames(["a"], a=[-1.0, -0.4, 0.1, 0.2, 12.0, 24.2, 24.6])
    spans, rejects = plan_spans(found, NIGHT)
    ((sensor, own),) = spans.items()
    assert (sensor.number, sensor.sensor_id) == (0, "a")
    hours = [(span.start_ns - MIDNIGHT_NS) / 3600e9 for span in own]
    assert hours == [-0.5, 0.0, 12.0, 24.0]
    assert all(span.end_ns - span.start_ns == SPAN_NS for span in own)
    assert rejects.num_rows == 0


def test_a_sensor_without_calibration_has_a_reject_and_no_spans():
    spans, rejects = plan_spans(frames(["b"], a=[1.0, 2.0], b=[1.0]), NIGHT)
    assert [sensor.sensor_id for sensor in spans] == ["b"]
    (row,) = rejects.select(["sensor_id", "stage", "reason", "count"]).to_pylist()
    assert row == {
        "sensor_id": "a", "stage": "identify", "reason": "no_calibration", "count": 2,
    }  # fmt: skip


def test_a_sensor_whose_velocities_are_wrong_is_used_without_them(monkeypatch):
    states = pa.table({"time": pa.array([MIDNIGHT_NS, MIDNIGHT_NS + 1]).cast(TIME)})
    monkeypatch.setattr(work, "states_between", lambda *_: states)
    spans, rejects = plan_spans(frames(["a", "b"], a=[1.0], b=[1.0]), NIGHT, {"b"})
    assert {sensor.sensor_id: sensor.has_velocities for sensor in spans} == {"a": True, "b": False}
    (row,) = rejects.select(["sensor_id", "reason", "count"]).to_pylist()
    assert row == {"sensor_id": "b", "reason": "wrong_velocity", "count": 2}


def test_no_calibration_at_all_is_an_error_that_says_what_to_do():
    says = (
        r"no sensor has a calibration \(a\).*name the log that has it.*only the logs of .*frame_id"
    )
    with pytest.raises(LogError, match=says):
        plan_spans(frames([], a=[1.0]), NIGHT)


def test_a_calibration_of_a_sensor_beside_the_night_alone_is_not_enough():
    with pytest.raises(LogError, match=r"no sensor has a calibration \(a, b\) on 2019-04-02"):
        plan_spans(frames(["b"], a=[1.0], b=[-0.4, 24.1]), NIGHT)


def test_invalid_calibrations_are_named_where_there_are_no_others():
    found = frames([], a=[1.0])
    invalid = reject_rows(Reason.FOLDED_IMAGE, sensor_id="a", time=[0], count=[1])
    with pytest.raises(LogError, match=r"those in the log are invalid: folded_image: .*D folds"):
        plan_spans(found._replace(rejects=invalid), NIGHT)


@pytest.mark.parametrize(
    ("stated", "kept"),
    [
        ([-30.0, 1.0], [1.0]),  # the night before has another one
        ([-30.0, -20.0], [-20.0]),
        ([-30.0, 3.0], [-30.0, 3.0]),  # it changes in the night
        ([1.0, 30.0], [1.0]),  # of the night after
        ([4.0, 30.0], [4.0]),  # the first one also before its time
        ([30.0, 31.0], [30.0]),
    ],
)
def test_calibrations_of_other_nights_are_not_those_of_a_night(stated, kept):
    found = frames([], a=[-30.0, 2.0, 5.0, 30.0], b=[30.0])
    times = MIDNIGHT_NS + (np.array([*stated, -3.0]) * 3600e9).astype(np.int64)
    rows = cameras(*["a"] * len(stated), "b")
    at = rows.schema.get_field_index("time")
    rows = rows.set_column(at, CAMERAS.field("time"), pa.array(times).cast(TIME))
    of_night = cameras_of_night(found._replace(cameras=rows), NIGHT)
    hours = (array(of_night, "time") - MIDNIGHT_NS) / 3600e9
    assert hours.tolist() == [*kept, -3.0]


def test_neighbours_are_worked_on_together():
    found = frames(["a", "b"], a=[1.0, 2.0], b=[1.0, 2.0])
    spans, _ = plan_spans(found, NIGHT)
    n_frames = count_frames(found, spans)
    work = Work(found.folder, WorkFolder(Path("/nowhere")), spans, n_frames, found.cameras, {})
    order = [(sensor.sensor_id, span.start_ns % DAY_NS) for sensor, span in work.by_span()]
    one, two = 2 * SPAN_NS, 4 * SPAN_NS
    assert order == [("a", one), ("b", one), ("a", two), ("b", two)]

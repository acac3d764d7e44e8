"""The layout of the work folder: every place has one path, under its stage."""

from epipole.io.work.parts import Parts
from epipole.io.work.places import ReadFolder, WorkFolder
from epipole.schemas.spans import SPAN_NS, Sensor, Span
from epipole.schemas.stages import Stage

SENSORS = [Sensor(0, "a"), Sensor(11, "b/..")]


def test_no_two_places_are_one(tmp_path):
    folder = WorkFolder(tmp_path)
    places: list[Parts] = []
    for sensor in SENSORS:
        places.append(folder.identified(sensor))
        places += [folder.identified_again(sensor, k) for k in (1, 2)]
        places += [folder.corrected(sensor, k) for k in (1, 2)]
        for k in range(3):
            places += [folder.tracked(sensor, k), folder.tracklet_names(sensor, k)]
    places += [folder.solved(k, everyone) for k in range(3) for everyone in (True, False)]
    paths = [parts.folder for parts in places]
    assert len(set(paths)) == len(paths)
    assert not any(one in other.parents for one in paths for other in paths)


def test_each_place_lies_under_its_stage(tmp_path):
    folder, sensor = WorkFolder(tmp_path), SENSORS[1]
    by_stage = {
        Stage.IDENTIFY: folder.identified(sensor),
        Stage.CALIBRATE: folder.identified_again(sensor, 1),
        Stage.CHECK: folder.corrected(sensor, 1),
        Stage.TRACK: folder.tracked(sensor, 0),
        Stage.SOLVE: folder.solved(0),
    }
    for stage, parts in by_stage.items():
        assert parts.folder.relative_to(tmp_path).parts[0] == stage
    read = ReadFolder(tmp_path)
    assert read.piece(3, 4).relative_to(tmp_path).parts == (Stage.READ, "log-3", "piece-4")
    assert read.sensor(3).relative_to(tmp_path).parts == (Stage.READ, "sensor-3")


def test_sensor_ids_are_no_part_of_a_path(tmp_path):
    span = Span(0, SPAN_NS)
    assert ".." not in str(WorkFolder(tmp_path).identified(SENSORS[1]).of(span))

"""The layout of the work folder: every place has one path, under its stage."""

from epipole.io.work.parts import ASSOCIATED, NUMBERED, SOLVED, Parts, write_part
from epipole.io.work.work_layout import ReadFolder, WorkFolder
from epipole.schemas.bridge import empty
from epipole.schemas.spans import BLOCK_NS, SPAN_NS, Sensor, Span
from epipole.schemas.stages import Stage

SENSORS = [Sensor(0, "a"), Sensor(11, "b/..")]
SPANS = [Span(k * SPAN_NS, (k + 1) * SPAN_NS) for k in range(2)]


def test_no_two_places_are_one(tmp_path):
    folder = WorkFolder(tmp_path)
    places: list[Parts] = []
    for sensor in SENSORS:
        places.append(folder.identified(sensor))
        places += [folder.identified_again(sensor, k) for k in (1, 2)]
        places += [folder.corrected(sensor, k) for k in (1, 2)]
        for k in range(3):
            places += [folder.tracked(sensor, k), folder.tracklet_names(sensor, k)]
            places.append(folder.viewed(k)[sensor.number])
    solved = [folder.solved(k, everyone) for k in range(3) for everyone in (True, False)]
    for of in solved:
        places += [of.blocks, of.objects, of.errors]
    paths = [parts.folder for parts in places]
    paths += [of.piece(span, k) for of in solved for span in SPANS for k in range(2)]
    assert len(set(paths)) == len(paths)
    assert not any(one in other.parents for one in paths for other in paths)


def test_each_place_lies_under_its_stage(tmp_path):
    folder, sensor = WorkFolder(tmp_path), SENSORS[1]
    by_stage = {
        Stage.IDENTIFY: folder.identified(sensor),
        Stage.CALIBRATE: folder.identified_again(sensor, 1),
        Stage.CHECK: folder.corrected(sensor, 1),
        Stage.TRACK: folder.tracked(sensor, 0),
        Stage.SOLVE: folder.viewed(0)[sensor.number],
    }
    for stage, parts in by_stage.items():
        assert parts.folder.relative_to(tmp_path).parts[0] == stage
    assert folder.solved(0).root.relative_to(tmp_path).parts[0] == Stage.SOLVE
    read = ReadFolder(tmp_path)
    assert read.piece(3, 4).relative_to(tmp_path).parts == (Stage.READ, "log-3", "piece-4")
    assert read.sensor(3).relative_to(tmp_path).parts == (Stage.READ, "sensor-3")


def test_sensor_ids_are_no_part_of_a_path(tmp_path):
    span = Span(0, SPAN_NS)
    assert ".." not in str(WorkFolder(tmp_path).identified(SENSORS[1]).of(span))


def test_the_pieces_of_a_span_are_in_the_order_of_their_numbers(tmp_path):
    solved = WorkFolder(tmp_path).solved(0)
    assert solved.pieces(SPANS[0]) == []
    tables = {name: empty(schema) for name, schema in SOLVED.items()}
    for number in (10, 2, 0, 11, 1):
        write_part(solved.piece(SPANS[0], number), SOLVED, tables)
    assert solved.pieces(SPANS[0]) == [solved.piece(SPANS[0], k) for k in (0, 1, 2, 10, 11)]
    assert len(solved.read(SPANS[0], "positions")) == 5
    assert solved.pieces(SPANS[1]) == solved.read(SPANS[1], "positions") == []


def test_a_span_is_held_once_its_objects_are_known(tmp_path):
    solved = WorkFolder(tmp_path).solved(0)
    write_part(solved.objects.of(SPANS[1]), NUMBERED, {"members": empty(NUMBERED["members"])})
    assert [solved.holds(span) for span in SPANS] == [False, True]


def test_the_blocks_of_a_span_are_those_that_exist(tmp_path):
    solved = WorkFolder(tmp_path).solved(0)
    tables = {name: empty(schema) for name, schema in ASSOCIATED.items()}
    for k in (2, 3, 5):  # of the first span one, of the second two
        block = Span(k * BLOCK_NS, (k + 1) * BLOCK_NS)
        assert block.span == SPANS[k // 3]
        write_part(solved.blocks.of(block), ASSOCIATED, tables)
    assert [len(solved.of_blocks(span, "members")) for span in SPANS] == [1, 2]

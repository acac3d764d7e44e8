"""Solve a piece: larger errors of sensors count for positions, not for the check of the sensors."""

import numpy as np
import pyarrow as pa
import pytest
from scenes.associations import SPAN, START_NS, block_of, tables, write_views
from scenes.tracklet_scenes import Scene

from epipole.io.work.part_tables import JUDGED, NUMBERED
from epipole.io.work.parts import read_part, write_part
from epipole.io.work.places import SolvedParts
from epipole.schemas.bridge import array, empty, table
from epipole.schemas.settings import Settings
from epipole.schemas.work_tables import SHARED_ERRORS
from epipole.tasks.solve.association.associate_block import object_members
from epipole.tasks.solve.association.associate_objects import associate_objects
from epipole.tasks.solve.positions.sample_sight_lines import LineSampling
from epipole.tasks.solve.positions.solve_piece import Piece, solve_piece

EVERY_NS = 10_000_000_000


@pytest.fixture(scope="module")
def block():
    of = tables(Scene(11, 4, times=np.arange(0.0, 60.0, 2.0)).objects(2, spread_km=300.0))
    views = of.views
    for name in ("sensor_vx_km_s", "sensor_vy_km_s", "sensor_vz_km_s"):
        at = views.schema.get_field_index(name)
        zero = pa.array(np.zeros(views.num_rows))
        views = views.set_column(at, views.schema.field(at), zero)
    return block_of(of._replace(views=views))


def piece_of(folder, block, errors, piece=0, count=1):
    """Solve a piece of the objects of a scene, with these errors of sensors."""
    settings, solved = Settings(), SolvedParts(folder)
    viewed = write_views(folder / "views", block.sensors, SPAN)
    members = object_members(block, associate_objects(block, settings))
    numbers = members["object"] if count > 1 else pa.array(np.zeros(members.num_rows, np.int64))
    at = members.schema.get_field_index("piece")
    members = members.set_column(at, members.schema.field(at), numbers)
    write_part(solved.objects.of(SPAN), NUMBERED, {"members": members})
    write_part(solved.errors.of(SPAN), JUDGED, {"errors": errors})
    made = Piece(SPAN, piece, count)
    n_positions = solve_piece.fn(
        viewed, made, 30_000_000_000, LineSampling(EVERY_NS), settings, solved
    )
    part = solved.piece(SPAN, piece)
    assert read_part(part, "positions").num_rows == n_positions
    return part


def larger(place: float) -> pa.Table:
    return table(SHARED_ERRORS, {"sensor_id": ["sat1"], "direction": [1.0], "place": [place]})


def test_positions_have_the_larger_errors_of_their_sensors(tmp_path, block):
    stated = read_part(piece_of(tmp_path / "a", block, empty(SHARED_ERRORS)), "positions")
    honest = read_part(piece_of(tmp_path / "b", block, larger(400.0)), "positions")
    assert stated.num_rows == honest.num_rows == 2 * 30
    assert (array(honest, "cov_xx") > array(stated, "cov_xx")).all()


def test_the_check_of_the_sensors_holds_them_against_their_stated_errors(tmp_path, block):
    """A fault that makes a sensor's errors larger would hide itself."""
    part = piece_of(tmp_path, block, larger(400.0))
    lines = read_part(part, "lines")
    assert set(lines["sensor_id"].to_pylist()) == {"sat0", "sat1", "sat2", "sat3"}
    np.testing.assert_allclose(array(lines, "position_sigma_km"), 0.02)


def test_lines_are_kept_at_some_epochs_only(tmp_path, block):
    lines = read_part(piece_of(tmp_path, block, empty(SHARED_ERRORS)), "lines")
    seconds = np.unique(array(lines, "epoch") - START_NS) / 1e9
    assert seconds.tolist() == [0.0, 10.0, 20.0, 30.0, 40.0, 50.0]
    assert lines.num_rows == 6 * 2 * 4


def test_the_pieces_together_are_the_whole(tmp_path, block):
    whole = piece_of(tmp_path / "whole", block, empty(SHARED_ERRORS))
    for name in ("positions", "associations", "states", "lines", "objects"):
        parts = [
            read_part(piece_of(tmp_path / f"{name}{k}", block, empty(SHARED_ERRORS), k, 2), name)
            for k in (0, 1)
        ]
        by = [("epoch", "ascending"), ("object_id", "ascending")]
        by += [("sensor_id", "ascending")] * (name in ("associations", "lines"))
        together = pa.concat_tables(parts).sort_by(by)
        assert together.equals(read_part(whole, name).sort_by(by)), name

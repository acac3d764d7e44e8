"""Read logs: the content of each log goes into parts with the declared tables."""

import logging

import pytest

from epipole.io.logs.writer import LogWriter
from epipole.io.work.parts import LOG_PIECE, read_part
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.errors import LogError
from epipole.tasks.read.read_logs import read_log_into

START_NS = 1_554_091_200_000_000_000


def test_a_log_becomes_pieces_with_the_declared_tables(tmp_path, caplog):
    with LogWriter(tmp_path / "a.mcap") as log:
        log.state("s", START_NS, position_km=[7000.0, 0.0, 0.0])
        for k in range(5):
            log.frame(
                "s", START_NS + k, frame_number=k, exposure_s=0.1, x_px=[1.0], y_px=[2.0]
            )  # fmt: skip
    folder = ReadFolder(tmp_path)
    with caplog.at_level(logging.DEBUG):
        read = read_log_into(folder, 3, str(tmp_path / "a.mcap"))
    assert (read.number, read.source.name) == (3, "a.mcap")
    pieces = [folder.piece(3, k) for k in range(read.n_pieces)]
    rows = {name: sum(read_part(p, name).num_rows for p in pieces) for name in LOG_PIECE}
    assert rows == {"exposures": 5, "states": 1, "cameras": 0, "rejects": 0}
    assert not folder.piece(3, read.n_pieces).exists()
    assert "a.mcap: read 5 frames" in caplog.text


def test_a_file_that_is_no_log_is_an_error_and_leaves_no_part(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"PNG")
    with pytest.raises(LogError, match=r"a\.mcap"):
        read_log_into(ReadFolder(tmp_path), 0, str(tmp_path / "a.mcap"))
    assert not (tmp_path / "read").exists()

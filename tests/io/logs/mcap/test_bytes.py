"""Logs in memory and in a bucket of an S3 server that the tests start."""

import functools
import hashlib
import http.server
import os
import random
import threading
from pathlib import Path

import pytest
from scenes.log_bytes import log_bytes
from scenes.twice import twice

from epipole.io.logs.mcap import bytes as log_blocks
from epipole.io.logs.reader import read_log, read_log_pieces
from epipole.io.logs.writer import LogWriter
from epipole.schemas.errors import LogError

START_NS = 1_554_091_200_000_000_000


@pytest.fixture
def log(tmp_path):
    path = tmp_path / "a.mcap"
    with LogWriter(path, chunk_size=1000) as out:
        for i in range(100):
            out.frame("s", START_NS + i, frame_number=i, exposure_s=1.0, x_px=[i] * 9, y_px=[i] * 9)
    return path


def line_of(url):
    with pytest.raises(LogError) as caught:
        twice(read_log)(url)
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(url)
    return line


def test_a_log_in_a_bucket_is_read_like_a_file(s3, log):
    s3.put_file(str(log), "logs/2019/a.mcap")
    there, here = twice(read_log)("s3://logs/2019/a.mcap"), read_log(log)
    assert there.exposures.equals(here.exposures)
    assert there.source == here.source


def test_a_log_that_is_not_in_the_bucket_is_an_error_of_one_line(s3, log):
    s3.put_file(str(log), "logs/folder/a.mcap")
    assert "no such file" in line_of("s3://logs/none.mcap")
    assert "no such file" in line_of("s3://no-such-bucket/a.mcap")
    assert "is a folder" in line_of("s3://logs/folder")


def test_a_server_that_does_not_answer_is_an_error_of_one_line(s3, monkeypatch):
    import s3fs

    monkeypatch.setenv("AWS_ENDPOINT_URL", "http://127.0.0.1:9")
    s3fs.S3FileSystem.clear_instance_cache()
    assert "cannot be read" in line_of("s3://logs/a.mcap")


class _WithoutLength(http.server.SimpleHTTPRequestHandler):
    """Sends a file and closes the connection where it ends."""

    def do_HEAD(self):
        self.send_response(200)
        self.end_headers()

    def do_GET(self):
        self.do_HEAD()
        self.wfile.write(Path(self.translate_path(self.path)).read_bytes())


@pytest.mark.parametrize(
    ("handler", "says"),
    [
        (http.server.SimpleHTTPRequestHandler, "more than the range that is asked for"),
        (_WithoutLength, "does not tell how large it is"),
    ],
)
def test_a_server_without_ranges_or_lengths_is_an_error_that_says_so(handler, says, log):
    with http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(handler, directory=str(log.parent))
    ) as serving:
        threading.Thread(target=serving.serve_forever, daemon=True).start()
        line = line_of(f"http://127.0.0.1:{serving.server_port}/a.mcap")
        serving.shutdown()
    assert says in line


def test_missing_credentials_are_an_error_of_one_line(s3, monkeypatch, tmp_path):
    import s3fs

    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("HOME", str(tmp_path))
    s3fs.S3FileSystem.clear_instance_cache()
    line = line_of("s3://logs/a.mcap")
    assert "credentials" in line.lower()


def test_a_log_in_a_bucket_is_fetched_by_ranges_and_once(s3, log, monkeypatch):
    s3.put_file(str(log), "logs/a.mcap")
    monkeypatch.setattr(log_blocks, "BLOCK_BYTES", 1000)
    fetched = []
    cat_file = s3.cat_file

    def counted(path, start, end):
        fetched.append((start, end))
        return cat_file(path, start=start, end=end)

    monkeypatch.setattr(s3, "cat_file", counted)
    whole = len(log.read_bytes()) // 1000
    for _ in range(2):
        fetched.clear()
        assert read_log("s3://logs/a.mcap").source == read_log(log).source
        blocks = [start for start, end in fetched if start % 1000 == 0 and end == start + 1000]
        assert sorted(blocks) == [1000 * k for k in range(whole)]


def test_a_log_that_changes_in_its_bucket_while_it_is_read_is_an_error(s3, log):
    for _ in range(2):
        s3.put_file(str(log), "logs/a.mcap")
        pieces = read_log_pieces("s3://logs/a.mcap", piece_bytes=1)
        next(pieces)
        s3.pipe_file("logs/a.mcap", bytes(log.stat().st_size))
        with pytest.raises(LogError, match=": changed while it was read"):
            list(pieces)


def test_a_log_that_vanishes_from_its_bucket_while_it_is_read_is_an_error(s3, log):
    for _ in range(2):
        s3.put_file(str(log), "logs/gone.mcap")
        pieces = read_log_pieces("s3://logs/gone.mcap", piece_bytes=1)
        next(pieces)
        s3.rm("logs/gone.mcap")
        with pytest.raises(LogError, match=r"gone\.mcap: no such file"):
            list(pieces)


@pytest.mark.parametrize("block_bytes", [1, 7, 100, 1 << 20])
@pytest.mark.parametrize("streaming", [True, False])
def test_any_bytes_of_a_log_can_be_viewed_in_any_order(block_bytes, streaming, monkeypatch):
    monkeypatch.setattr(log_blocks, "BLOCK_BYTES", block_bytes)
    data = random.Random(0).randbytes(1000)
    with log_bytes(data) as log:
        if streaming:
            log.stream()
        for start, end in [(0, 0), (0, 9), (990, 1000), (5, 800), (3, 4), (1000, 1000), (0, 1000)]:
            assert log.view(start, end) == data[start:end]
        assert log.sha256() == hashlib.sha256(data).hexdigest()


def test_an_unreadable_file_is_an_error_of_one_line(log):
    if os.geteuid() == 0:
        pytest.skip("root reads everything")
    log.chmod(0)
    assert "Permission denied" in line_of(str(log))

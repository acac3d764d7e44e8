"""When messages were logged, and the bytes of a log up to a time, while the log is written."""

import hashlib

import fsspec
import pytest
from mcap.writer import Writer

from epipole.io.logs.logged_times import ReadBytes, read_digest, read_log_times
from epipole.io.logs.writer import LogWriter

START_NS, SECOND_NS = 1_554_091_200_000_000_000, 1_000_000_000
N_FRAMES = 40


@pytest.fixture
def closed(tmp_path):
    """Return a log of many chunks, a frame a second."""
    with LogWriter(tmp_path / "a.mcap", chunk_size=200, compression="none") as log:
        for k in range(N_FRAMES):
            t = START_NS + k * SECOND_NS
            log.frame("a", t, frame_number=k, exposure_s=0.1, x_px=[1.0], y_px=[2.0])
    return tmp_path / "a.mcap"


def cut(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    return path


def test_a_log_that_is_still_written_tells_its_times_by_its_chunks(closed):
    whole = read_log_times(closed)
    assert whole == (START_NS, START_NS + (N_FRAMES - 1) * SECOND_NS)
    first, last = read_log_times(cut(closed, 0.5))
    assert first == START_NS
    assert START_NS + 5 * SECOND_NS < last < whole[1]


def test_damage_between_its_chunks_is_a_log_of_unknown_times(closed):
    data = bytearray(cut(closed, 0.5).read_bytes())
    at = 8 + 9 + int.from_bytes(data[9:17], "little")  # the first record behind the header
    data[at] = 0xEE
    closed.write_bytes(data)
    assert read_log_times(closed) is None


def test_what_is_logged_after_a_time_does_not_change_the_digest(closed):
    early, late = (START_NS + k * SECOND_NS for k in (5, N_FRAMES + 1))
    of_closed = [read_digest(str(closed), until) for until in (early, late)]
    path = cut(closed, 0.5)
    of_open = [read_digest(str(path), until) for until in (early, late)]
    assert of_open[0] == of_closed[0]
    assert of_open[1] != of_closed[1]
    assert read_digest(str(path), late, ReadBytes("known", 1000)) == "known"


def test_of_a_log_that_grew_since_it_was_read_only_what_was_read_counts(closed):
    """A night that was made from half a copy must not be known as made from the whole."""
    data, until_ns = closed.read_bytes(), START_NS + 20 * SECOND_NS
    before = read_digest(str(closed), until_ns)
    for share, is_all in ((0.3, False), (0.9, True)):
        part = data[: int(share * len(data))]
        read = ReadBytes(hashlib.sha256(part).hexdigest(), len(part))
        assert (read_digest(str(closed), until_ns, read) == before) == is_all
        closed.write_bytes(part)
        assert read_digest(str(closed), until_ns, read) == (before if is_all else read.sha256)
        closed.write_bytes(data)


def test_a_closed_log_without_statistics_tells_its_times_by_its_chunks(tmp_path):
    with (tmp_path / "a.mcap").open("wb") as file:
        writer = Writer(file, chunk_size=200, use_statistics=False)
        writer.start()
        channel = writer.register_channel("/a", "json", 0)
        for k in range(N_FRAMES):
            t = START_NS + k * SECOND_NS
            writer.add_message(channel, t, b"{}", t)
        writer.finish()
    last_ns = START_NS + (N_FRAMES - 1) * SECOND_NS
    assert read_log_times(tmp_path / "a.mcap") == (START_NS, last_ns)


@pytest.mark.parametrize(("share", "limit"), [(1.0, 5), (0.9, 10)])
def test_few_requests_tell_the_times_and_the_digest_of_a_log_behind_a_url(
    share, limit, closed, monkeypatch
):
    memory = fsspec.filesystem("memory")
    memory.pipe_file("/times/a.mcap", cut(closed, share).read_bytes())
    cat_file, n = memory.cat_file, []
    monkeypatch.setattr(memory, "cat_file", lambda *a, **b: n.append(1) or cat_file(*a, **b))
    early_ns = START_NS + 5 * SECOND_NS
    assert read_log_times("memory://times/a.mcap") == read_log_times(closed)
    assert len(n) < limit
    assert read_digest("memory://times/a.mcap", early_ns) == read_digest(str(closed), early_ns)
    assert len(n) < 2 * limit
    memory.rm("/times", recursive=True)

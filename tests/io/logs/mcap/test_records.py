"""Damaged logs: what is still read, and what is reported of the rest."""

import io
import struct
import time
import zlib
from concurrent.futures import ThreadPoolExecutor

import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from scenes.hand_made_logs import (
    CHANNEL_BODY,
    DECLARED,
    HEAD,
    SCHEMA,
    SCHEMA_BODY,
    chunk,
    hand_made,
    message,
    record,
    walk,
)
from scenes.log_bytes import log_bytes

from epipole.io.logs.mcap.container import MAX_CHUNK_BYTES
from epipole.io.logs.mcap.damage_rows import MAX_ALIKE
from epipole.io.logs.mcap.records import RecordWalk

N = 40


def log(compression=CompressionType.ZSTD, **options):
    """Return the bytes of a log of N messages of 100 bytes, about 5 per chunk."""
    out = io.BytesIO()
    writer = Writer(out, chunk_size=500, compression=compression, **options)
    writer.start()
    schema = writer.register_schema(SCHEMA, "protobuf", b"")
    channel = writer.register_channel("/a", "protobuf", schema)
    other = writer.register_channel("/b", "json", writer.register_schema("other", "", b""))
    for i in range(N):
        # Does not compress, so that a cut chunk still has its first messages.
        body = struct.pack("<I", i) + b"".join(
            zlib.crc32(bytes([i, j])).to_bytes(4, "little") for j in range(24)
        )
        writer.add_message(channel, 1000 + 2 * i, body, 0)
        writer.add_message(other, 1001 + 2 * i, b"{}", 0)
    writer.finish()
    return out.getvalue()


def chunks(data):
    """Return (place, length) of each chunk."""
    summary = make_reader(io.BytesIO(data)).get_summary()
    return [(c.chunk_start_offset, c.chunk_length) for c in summary.chunk_indexes]


def chunk_messages(data, i):
    summary = make_reader(io.BytesIO(data)).get_summary()
    c = summary.chunk_indexes[i]
    return [n for n in range(N) if c.message_start_time <= 1000 + 2 * n <= c.message_end_time]


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_sound_log_gives_every_wanted_message_and_no_damage(compression):
    assert walk(log(compression)) == (list(range(N)), [])


@pytest.mark.parametrize("crc", [True, False])
def test_a_log_without_chunks_is_read_too(crc):
    data = log(use_chunking=False, enable_data_crcs=crc)
    assert walk(data) == (list(range(N)), [])


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_log_cut_anywhere_gives_what_lies_before_and_is_reported(compression):
    data = log(compression)
    places = chunks(data)
    for cut in range(200, places[-1][0], 97):
        found, damage = walk(data[:cut])
        whole = sum(
            len(chunk_messages(data, i)) for i, (at, n) in enumerate(places) if at + n <= cut
        )
        assert found == list(range(len(found)))
        assert len(found) >= whole
        assert damage == [("truncated", 1)]


@pytest.mark.parametrize("compression", [CompressionType.NONE, CompressionType.LZ4])
def test_a_cut_chunk_gives_its_first_messages(compression):
    data = log(compression, use_statistics=False)
    at, length = chunks(data)[2]
    found, _ = walk(data[: at + length - 30])
    before = len(chunk_messages(data, 0)) + len(chunk_messages(data, 1))
    # LZ4 hands out whole blocks, of which a chunk this small is one.
    minimum = before + (1 if compression is CompressionType.NONE else 0)
    assert found == list(range(len(found)))
    assert len(found) >= minimum


def test_a_chunk_with_a_flipped_bit_is_left_out_and_its_messages_counted():
    data = bytearray(log(CompressionType.NONE))
    at, length = chunks(data)[3]
    data[at + length - 20] ^= 1
    lost = chunk_messages(data, 3)
    found, damage = walk(data)
    assert found == [n for n in range(N) if n not in lost]
    assert damage == [("bad_checksum", len(lost))]


def test_schemas_and_channels_of_a_lost_first_chunk_come_from_the_summary():
    data = bytearray(log(CompressionType.NONE))
    at, length = chunks(data)[0]
    data[at + length - 20] ^= 1
    found, damage = walk(data)
    assert found == list(range(len(chunk_messages(data, 0)), N))
    assert damage == [("bad_checksum", len(chunk_messages(data, 0)))]


def test_without_a_summary_messages_of_an_unknown_channel_are_counted():
    data = bytearray(log(CompressionType.NONE))
    at, length = chunks(data)[0]
    lost = len(chunk_messages(data, 0))
    end = chunks(data)[-1][0]
    data[at + length - 20] ^= 1
    found, damage = walk(data[:end])
    assert found == []
    known = sum(
        len(chunk_messages(log(CompressionType.NONE), i))
        for i in range(len(chunks(log(CompressionType.NONE))) - 1)
    )
    assert ("unknown_channel", known - lost) in damage


@pytest.mark.parametrize("length", [0, 5, 1 << 20, 1 << 63])
@pytest.mark.parametrize("closed", [True, False])
def test_a_chunk_whose_records_length_is_damaged_is_found_by_its_own(length, closed):
    data = bytearray(log())
    last = chunks(data)[-1][0]
    struct.pack_into("<Q", data, chunks(data)[2][0] + 1, length)
    expected = list(range(N)) if closed else list(range(chunk_messages(log(), -1)[0]))
    assert walk(data if closed else data[:last])[0] == expected


@pytest.mark.parametrize("length", [0, 5, 1 << 20, 1 << 63])
def test_after_a_damaged_record_the_next_chunk_of_the_summary_is_read(length):
    data = bytearray(log())
    at, size = chunks(data)[2]
    struct.pack_into("<Q", data, at + size + 1, length)  # of the message index that follows
    found, damage = walk(data)
    assert found == list(range(N))
    assert {reason for reason, _ in damage} == {"damaged_record"}


@pytest.mark.parametrize("opcode", [0x00, 0x02, 0x04, 0x07, 0x0E, 0x0F, 0x16, 0x46, 0x86])
def test_a_chunk_with_a_damaged_opcode_is_reported(opcode):
    data = bytearray(log())
    lost = chunk_messages(data, 2)
    data[chunks(data)[2][0]] = opcode
    found, damage = walk(data)
    assert found == [n for n in range(N) if n not in lost]
    # By the chunk's indexes or by the summary: a chunk that looks like an index hides a part.
    assert sum(n for reason, n in damage if reason == "missing_messages") == len(lost)


@pytest.mark.parametrize("opcode", [0x09, 0x20, 0x80, 0xFF])
def test_without_a_summary_the_indexes_of_a_chunk_tell_what_is_missing(opcode):
    """A record of a private opcode would else be skipped without a word."""
    data = bytearray(log())
    places, lost = chunks(data), chunk_messages(data, 2)
    data[places[2][0]] = opcode
    found, damage = walk(data[: places[-1][0]])
    assert found == [n for n in range(chunk_messages(log(), -1)[0]) if n not in lost]
    assert ("missing_messages", len(lost)) in damage


def test_the_index_of_a_chunk_counts_the_messages_behind_damage_in_it():
    data = bytearray(log(CompressionType.NONE, enable_crcs=False))
    at, length = chunks(data)[2]
    lost = chunk_messages(data, 2)
    head = HEAD.pack(5, 22 + 100)
    second = data.index(head, data.index(head, at) + 1, at + length)
    data[second + 8] = 0x7F  # its length is beyond the chunk
    found, damage = walk(data)
    assert found == [n for n in range(N) if n not in lost[1:]]
    assert damage == [("damaged_chunk", 1), ("missing_messages", len(lost) - 1)]


def test_a_file_that_ends_in_zeros_is_read_to_there():
    data = log()
    at = chunks(data)[3][0]
    assert walk(data[:at] + bytes(5000)) == (
        list(range(chunk_messages(data, 3)[0])),
        [("truncated", 1)],
    )


def with_chunk(data, i, change):
    """Return the log with fields of a chunk replaced: size, or compression."""
    data = bytearray(data)
    at = chunks(data)[i][0] + HEAD.size
    if "size" in change:
        data[at + 16 : at + 24] = struct.pack("<Q", change["size"])
    if "compression" in change:
        data[at + 32 : at + 36] = change["compression"]
    return data


def test_an_absurd_size_is_refused_before_decompression():
    data = with_chunk(log(), 1, {"size": MAX_CHUNK_BYTES + 1})
    _, damage = walk(data)
    assert damage == [("chunk_too_large", len(chunk_messages(log(), 1)))]


@pytest.mark.parametrize("size", [0, 10, 100_000])
def test_another_size_than_declared_is_refused(size):
    _, damage = walk(with_chunk(log(), 1, {"size": size}))
    assert damage == [("wrong_chunk_size", len(chunk_messages(log(), 1)))]


def test_a_chunk_of_unknown_compression_is_left_out():
    _, damage = walk(with_chunk(log(), 1, {"compression": b"snap"}))
    assert damage == [("unknown_compression", len(chunk_messages(log(), 1)))]


def message_place(data, i):
    """Return where the values of message `i` begin."""
    return data.find(struct.pack("<I", i) + zlib.crc32(bytes([i, 0])).to_bytes(4, "little"))


def without_schema(data):
    """Return a log without its first schema; the footer stays as it was."""
    at = data.index(b"\x03", 8 + HEAD.unpack_from(data, 8)[1] + HEAD.size)
    return data[:at] + data[at + HEAD.size + HEAD.unpack_from(data, at)[1] :]


@pytest.mark.parametrize("closed", [True, False])
def test_a_flipped_bit_outside_chunks_is_reported_and_costs_no_other_message(closed):
    data = bytearray(log(use_chunking=False, enable_data_crcs=True))
    data[message_place(data, 20) + 9] ^= 4
    data[-1] ^= not closed  # without a summary the checksum is found by the walk
    found, damage = walk(data)
    assert (found, damage) == (list(range(N)), [("bad_data_checksum", 1)])


def test_a_wrong_checksum_of_the_data_section_is_reported_at_its_place():
    data = bytearray(log(use_chunking=False, enable_data_crcs=True))
    data[message_place(data, 20) + 9] ^= 4
    walked = RecordWalk(log_bytes(bytes(data)), frozenset([SCHEMA]))
    assert len(list(walked.blocks())) == 1
    assert data[walked.damage[0].offset] == 15  # the record that ends the data section


@pytest.mark.parametrize("summary", [True, False])
def test_a_schema_cut_out_of_a_log_with_a_checksum_is_reported(summary):
    """The footer's offsets do not fit any more, so the summary does not count."""
    options = {} if summary else {"repeat_schemas": False, "repeat_channels": False}
    whole = log(use_chunking=False, enable_data_crcs=True, **options)
    found, damage = walk(without_schema(whole))
    assert found == []
    assert damage == [("bad_data_checksum", 1), ("unknown_schema", N)]


def test_chunks_without_a_checksum_are_covered_by_that_of_the_data_section():
    data = bytearray(log(CompressionType.NONE, enable_crcs=False, enable_data_crcs=True))
    data[message_place(data, 20) + 9] ^= 4
    assert walk(data) == (list(range(N)), [("bad_data_checksum", 1)])


def test_each_log_of_a_sequence_has_its_checksum():
    data = log(use_chunking=False, enable_data_crcs=True)
    assert walk(data + data) == ([*range(N), *range(N)], [("log_behind_log", 1)])
    damaged = bytearray(data + data)
    damaged[message_place(data, 20) + 9] ^= 4
    assert walk(damaged)[1] == [("bad_data_checksum", 1), ("log_behind_log", 1)]


@pytest.mark.parametrize("kind", [0x0F, 0x02])
def test_a_record_that_says_it_ends_the_data_ends_nothing_before_the_end(kind):
    data = hand_made(DECLARED, message(0), record(kind, bytes(4)), message(1))[:-1]
    found, damage = walk(data)
    assert found == [0, 1]
    assert ("damaged_record", 1) in damage


def test_bytes_behind_a_log_are_reported():
    assert walk(hand_made(DECLARED, message(0)) + b"more") == ([0], [("damaged_record", 1)])


def test_a_message_that_only_the_statistics_count_is_reported_as_missing():
    data = log(use_chunking=False)
    # Take one message record of the wanted channel out of the data section.
    place = data.find(struct.pack("<I", 20) + zlib.crc32(bytes([20, 0])).to_bytes(4, "little")) - 31
    length = HEAD.unpack_from(data, place)[1] + HEAD.size
    start = len(data) - 8 - 29 + 9
    summary, offsets = struct.unpack_from("<QQ", data, start)
    cut = bytearray(data[:place] + data[place + length :])
    struct.pack_into("<QQI", cut, start - length, summary - length, offsets - length, 0)
    found, damage = walk(cut)
    assert found == [n for n in range(N) if n != 20]
    assert damage == [("missing_messages", 1)]


@pytest.mark.parametrize("count", [1 << 62, 1 << 63, (1 << 64) - 1])
def test_a_count_beyond_all_that_a_log_can_hold_is_damage(count):
    data = bytearray(log())
    start = len(data) - 8 - 29 + 9
    (summary,) = struct.unpack_from("<Q", data, start)
    statistics = data.find(b"\x0b", summary)
    while HEAD.unpack_from(data, statistics)[1] > len(data) - statistics:
        statistics = data.find(b"\x0b", statistics + 1)
    (size,) = struct.unpack_from("<I", data, statistics + HEAD.size + 42)
    for at in range(0, size, 10):
        struct.pack_into("<Q", data, statistics + HEAD.size + 46 + at + 2, count)
    struct.pack_into("<I", data, start + 16, 0)  # no checksum of the summary
    found, damage = walk(data)
    assert found == list(range(N))
    assert damage == [("damaged_record", 1)]


def test_a_wrong_summary_is_not_used():
    data = bytearray(log())
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    place = data.rfind(b"/b")
    data[place + 1] = ord("c")
    assert walk(data) == (list(range(N)), [])


@pytest.mark.parametrize("bit", range(12))
def test_an_offset_in_the_summary_that_is_wrong_costs_no_chunk(bit):
    data = bytearray(log())
    start = len(data) - 8 - 29 + 9
    struct.pack_into("<I", data, start + 16, 0)  # no checksum of the summary
    at, _ = chunks(data)[3]
    place = data.rfind(struct.pack("<Q", at), struct.unpack_from("<Q", data, start)[0])
    data[place + bit // 8] ^= 1 << bit % 8
    assert walk(data) == (list(range(N)), [])


# Logs that are made to be a burden


def test_a_log_by_hand_is_sound():
    assert walk(hand_made(chunk(DECLARED + message(3)), DECLARED + message(4))) == ([3, 4], [])


def test_channels_may_be_declared_before_every_message():
    records = b"".join(DECLARED + message(i) for i in range(50))
    assert walk(hand_made(chunk(records))) == (list(range(50)), [])


def test_a_chunk_in_a_chunk_is_left_out_and_reported():
    records = DECLARED + message(0) + chunk(message(1)) + message(2)
    assert walk(hand_made(chunk(records))) == ([0, 2], [("damaged_record", 1)])


@pytest.mark.parametrize("padding", [b"\0" * 40, b"\xff" * 7, b"\0"])
def test_records_that_are_longer_than_their_fields_are_sound(padding):
    def padded(whole):
        return record(whole[0], whole[HEAD.size :] + padding)

    declared = padded(record(3, SCHEMA_BODY)) + padded(record(4, CHANNEL_BODY))
    index = record(7, struct.pack("<HI", 1, 16) + bytes(16))
    data = hand_made(
        padded(chunk(declared + message(3))), padded(index), padded(chunk(message(5))), message(4)
    )
    at_end = data.rfind(record(15, bytes(4)))
    data = data[:at_end] + record(15, bytes(4) + padding) + data[at_end + HEAD.size + 4 :]
    assert walk(data) == ([3, 5, 4], [])


def cpu_seconds(data):
    started = time.process_time()
    got = walk(data)
    return got, time.process_time() - started


def test_what_a_small_log_unpacks_is_bounded():
    """Ten million empty messages in 40 kB."""
    empty = record(5, struct.pack("<HIQQ", 1, 0, 1000, 0)) * 250_000
    packed = zstandard.ZstdCompressor().compress(empty)
    head = struct.pack("<QQQI", 1000, 2000, len(empty), 0) + struct.pack("<I", 4) + b"zstd"
    bomb = record(6, head + struct.pack("<Q", len(packed)) + packed)
    walked = RecordWalk(log_bytes(hand_made(DECLARED, *[bomb] * 40)), frozenset([SCHEMA]))
    assert sum(len(block.start) for block in walked.blocks()) == 2 * 250_000
    assert [d.reason for d in walked.damage] == ["chunk_too_large"] * 38


def test_a_channel_that_is_declared_again_and_again_costs_little():
    records = (DECLARED + message(1)) * 100_000
    (found, damage), seconds = cpu_seconds(hand_made(chunk(records)))
    assert (len(found), damage) == (100_000, [])
    assert seconds < 5


def test_damage_without_number_is_few_rows_that_count_all_of_it():
    strange = record(0x20, b"")
    found, damage = walk(hand_made(DECLARED, message(1), strange * 20_000))
    assert (found, sum(n for _, n in damage)) == ([1], 20_000)
    assert len(damage) < 10
    bad = bytearray(chunk(message(1)))
    bad[-1] ^= 1
    found, damage = walk(hand_made(DECLARED, message(1), *[bad, strange] * 3000))
    assert found == [1]
    assert damage.count(("damaged_record", 1)) == MAX_ALIKE - 1
    assert len(damage) == 2 * MAX_ALIKE
    assert sum(n for _, n in damage) == 6000


def test_messages_that_are_too_short_are_counted():
    records = DECLARED + record(5, b"abc") + message(1) + record(5, b"")
    assert walk(hand_made(chunk(records))) == ([1], [("damaged_record", 2)])
    assert walk(hand_made(records)) == ([1], [("damaged_record", 2)])


def test_private_records_are_skipped():
    own = record(0x80, b"") * 3 + record(0xFF, b"any")
    assert walk(hand_made(own, chunk(DECLARED + own + message(1)), own)) == ([1], [])


def test_after_an_invalid_declaration_the_rest_is_read():
    records = DECLARED + record(4, b"") + record(3, b"\1") + message(1)
    assert walk(hand_made(chunk(records))) == ([1], [("damaged_record", 2)])


def test_the_same_chunk_twice_is_read_twice():
    whole = chunk(DECLARED + message(1))
    assert walk(hand_made(whole, whole)) == ([1, 1], [])


@pytest.mark.parametrize("crc", [True, False])
def test_logs_in_sequence_in_one_file_are_read_and_reported(crc):
    data = log(enable_crcs=crc)
    found, damage = walk(data * 3)
    assert found == list(range(N)) * 3
    assert damage == [("log_behind_log", 1)] * 2


def test_a_log_after_a_log_without_a_summary_is_read():
    data = hand_made(chunk(DECLARED + message(1)))
    assert walk(data + data) == ([1, 1], [("log_behind_log", 1)])


def test_opening_ahead_changes_nothing():
    data = bytearray(log())
    at, length = chunks(data)[3]
    data[at + length - 20] ^= 1
    with ThreadPoolExecutor(3) as pool:
        walked = RecordWalk(log_bytes(bytes(data)), frozenset([SCHEMA]), pool)
        found = [int(b.data[at : at + 4].view("<u4")[0]) for b in walked.blocks() for at in b.start]
    assert (found, [(d.reason, d.n) for d in walked.damage]) == walk(data)

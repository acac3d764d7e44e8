"""Messages without a declaration of their channel or its schema before them."""

import pytest
from scenes.hand_made_logs import (
    SCHEMA,
    channel_body,
    chunk,
    hand_made,
    message,
    record,
    schema_body,
    walk,
)
from scenes.log_bytes import log_bytes

from epipole.io.logs.mcap.records import RecordWalk


def schema(*args, **options):
    return record(3, schema_body(*args, **options))


def channel(*args, **options):
    return record(4, channel_body(*args, **options))


def loose(records):
    return records


in_chunks_and_outside = pytest.mark.parametrize("form", [chunk, loose])
MESSAGES = message(0) + message(1)


@in_chunks_and_outside
@pytest.mark.parametrize(
    "records",
    [
        [MESSAGES, channel(), schema()],
        [channel(), MESSAGES, schema()],
        [channel(), schema() + MESSAGES],
        [schema(), MESSAGES, channel() + message(2)],
        [schema() + message(0), channel() + message(1)],
        [MESSAGES + schema() + channel()],
        [schema() + channel(schema=7) + MESSAGES, schema(7) + message(2)],
    ],
)
def test_what_is_declared_later_in_the_file_is_read(form, records):
    found, damage = walk(hand_made(*map(form, records)))
    assert sorted(found) == list(range(len(found)))
    assert len(found) == b"".join(records).count(record(5, bytes(26))[:9])
    assert damage == []


@in_chunks_and_outside
def test_each_message_before_its_declaration_is_read_once(form):
    """Those of two channels, and of blocks with messages before and behind the declaration."""
    first = [message(0), message(1, channel=2), message(2)]
    then = [schema(), message(3, channel=2), channel(), message(4), message(5, channel=2)]
    last = [channel(2), message(6, channel=2), message(7)]
    found, damage = walk(hand_made(*(form(b"".join(part)) for part in (first, then, last))))
    assert (sorted(found), damage) == (list(range(8)), [])


@in_chunks_and_outside
@pytest.mark.parametrize("in_data", [[], [channel()], [schema()]])
def test_what_only_the_summary_declares_is_read(form, in_data):
    data = hand_made(*in_data, form(MESSAGES), summary=schema() + channel())
    assert walk(data) == ([0, 1], [])


@in_chunks_and_outside
def test_a_channel_in_the_data_may_have_its_schema_in_the_summary(form):
    assert walk(hand_made(form(channel() + MESSAGES), summary=schema())) == ([0, 1], [])


@in_chunks_and_outside
@pytest.mark.parametrize(
    ("declared", "reason"),
    [
        (b"", "unknown_channel"),
        (schema(), "unknown_channel"),
        (channel(), "unknown_schema"),
        (schema(2) + channel(), "unknown_schema"),
        (schema(0) + channel(schema=3), "unknown_schema"),
    ],
)
def test_what_is_never_declared_is_a_row_of_rejects_for_each_channel(form, declared, reason):
    data = hand_made(form(declared + MESSAGES), form(message(2)), form(message(3, channel=9)))
    walked = RecordWalk(log_bytes(data), frozenset([SCHEMA]))
    assert list(walked.blocks()) == []
    assert [(d.reason, d.n) for d in walked.damage] == [(reason, 3), ("unknown_channel", 1)]
    assert [d.time_ns for d in walked.damage] == [1000, 1003]
    assert data[walked.damage[0].offset] in (5, 6)  # the first message, or its chunk


@in_chunks_and_outside
def test_a_channel_without_a_schema_is_none_of_ours(form):
    """MCAP allows it: its schema has the number zero, and a schema of that number is ignored."""
    assert walk(hand_made(form(schema(0) + channel(schema=0) + MESSAGES))) == ([], [])


@in_chunks_and_outside
@pytest.mark.parametrize(
    "again",
    [
        schema(name="other"),
        channel(topic="/b", schema=0),
        channel(schema=9),
        schema(2, "other") + channel(schema=2),
    ],
)
def test_a_second_declaration_that_would_hide_messages_is_left_out(form, again):
    data = hand_made(form(schema() + channel() + message(0) + again + message(1)))
    assert walk(data) == ([0, 1], [("damaged_record", 1)])


@in_chunks_and_outside
@pytest.mark.parametrize(
    "again", [schema(data=b"new"), channel(topic="/b"), channel(), schema(2) + channel(schema=2)]
)
def test_a_second_declaration_that_hides_nothing_is_taken(form, again):
    data = hand_made(form(schema() + channel() + message(0) + again + message(1)))
    assert walk(data) == ([0, 1], [])


@in_chunks_and_outside
def test_a_second_declaration_may_turn_other_messages_into_wanted_ones(form):
    before = schema(2, "other") + channel(schema=2) + message(0)
    assert walk(hand_made(form(before + schema() + channel() + message(1)))) == ([1], [])


@in_chunks_and_outside
def test_a_declaration_that_contradicts_the_summary_is_left_out(form):
    data = form(schema(name="fpipole.CentroidFrame") + channel() + MESSAGES)
    found = walk(hand_made(data, summary=schema() + channel()))
    assert found == ([0, 1], [("damaged_record", 1)])


def test_logs_in_sequence_may_use_a_number_for_different_channels():
    other = hand_made(schema(name="other") + channel(topic="/b") + message(5))
    ours = hand_made(schema() + channel() + message(0), summary=schema() + channel())
    for logs in (other + ours, ours + other, other + ours + other):
        found, damage = walk(logs)
        assert found == [0]
        assert {reason for reason, _ in damage} == {"log_behind_log"}


def test_in_a_sequence_of_logs_each_log_declares_its_own_late_channels():
    late = hand_made(message(0) + schema() + channel() + message(1))
    never = hand_made(message(2))
    found, damage = walk(late + never + late)
    assert sorted(found) == [0, 0, 1, 1]
    assert ("unknown_channel", 1) in damage

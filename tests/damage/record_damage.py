"""Damage to whole records of a log. The rest of the file is sound, and mostly the summary too."""

import struct
import zlib
from collections.abc import Callable
from random import Random

from damage.container import (
    CHANNEL,
    CHUNK,
    MESSAGE,
    SCHEMA,
    Record,
    joined,
    records_in,
    records_of,
    split,
)
from damage.sound_logs import FORMS, sound_log

Records = list[Record]
CHUNK_HEAD = struct.Struct("<QQQI")
OPCODES = (*range(0x11), 0x20, 0x7F, 0x80, 0xFF)
DECLARATIONS = (SCHEMA, CHANNEL)
ODD_TIMES = (0, 1, 1 << 62, (1 << 63) - 1, 1 << 63, (1 << 64) - 1)


def swap_records(chance: Random, data: Records) -> Records:
    """Return the records with two in each other's place."""
    i, j = (chance.randrange(len(data)) for _ in "ij")
    out = list(data)
    out[i], out[j] = out[j], out[i]
    return out


def shuffle_records(chance: Random, data: Records) -> Records:
    """Return the records in another order, the first and the last in place."""
    middle = data[1:-1]
    chance.shuffle(middle)
    return [data[0], *middle, data[-1]]


def remove_record(chance: Random, data: Records) -> Records:
    """Return the records without one."""
    i = chance.randrange(len(data))
    return data[:i] + data[i + 1 :]


def repeat_record(chance: Random, data: Records) -> Records:
    """Return the records with one of them again, at another place."""
    out = list(data)
    out.insert(chance.randrange(len(out)), chance.choice(data))
    return out


def move_record(chance: Random, data: Records) -> Records:
    """Return the records with one of them at another place, mostly a schema or a channel."""
    declared = [i for i, record in enumerate(data) if record.opcode in DECLARATIONS]
    i = (
        chance.choice(declared)
        if declared and chance.random() < 0.7
        else chance.randrange(len(data))
    )
    out = [*data[:i], *data[i + 1 :]]
    out.insert(chance.randrange(len(out) + 1), data[i])
    return out


def remove_declaration(chance: Random, data: Records) -> Records:
    """Return the records without a schema or a channel, here or in a chunk."""
    return _declarations_changed(chance, data, _without_one)


def exchange_numbers(chance: Random, data: Records) -> Records:
    """Return the records, two schemas or channels under each other's number."""
    return _declarations_changed(chance, data, _exchanged)


def move_declarations(chance: Random, data: Records) -> Records:
    """Return the records, those of a chunk or of the data section in another order."""
    return _declarations_changed(chance, data, shuffle_records)


def insert_empty_records(chance: Random, data: Records) -> Records:
    """Return the records with many empty ones of one kind at one place."""
    i, n = chance.randrange(len(data) + 1), chance.choice((1, 10, 1000, 20_000))
    return [*data[:i], *[Record(chance.choice(OPCODES), b"")] * n, *data[i:]]


def _declarations_changed(
    chance: Random, data: Records, change: Callable[[Random, Records], Records]
) -> Records:
    """Return the records after a change of those that hold a declaration, or of a chunk's own."""
    if any(record.opcode in DECLARATIONS for record in data):
        return change(chance, data)
    for i, record in enumerate(data):
        if record.opcode == CHUNK and record.body[28:32] == bytes(4):
            start, end, *_ = CHUNK_HEAD.unpack_from(record.body)
            inside = change(chance, records_in(record.body[40:]))
            packed = b"".join(each.data for each in inside)
            head = CHUNK_HEAD.pack(start, end, len(packed), zlib.crc32(packed))
            body = head + bytes(4) + struct.pack("<Q", len(packed)) + packed
            return _with(data, i, record._replace(body=body))
    return move_record(chance, data)


def _without_one(chance: Random, data: Records) -> Records:
    places = [i for i, record in enumerate(data) if record.opcode in DECLARATIONS]
    i = chance.choice(places) if places else 0
    return data[:i] + data[i + bool(places) :]


def _exchanged(chance: Random, data: Records) -> Records:
    opcode = chance.choice(DECLARATIONS)
    places = [i for i, record in enumerate(data) if record.opcode == opcode]
    if len(places) < 2:
        return data
    i, j = chance.sample(places, 2)
    out = list(data)
    out[i] = data[i]._replace(body=data[j].body[:2] + data[i].body[2:])
    out[j] = data[j]._replace(body=data[i].body[:2] + data[j].body[2:])
    return out


def change_opcode(chance: Random, data: Records) -> Records:
    """Return the records, one of them under another opcode."""
    i = chance.randrange(len(data))
    return _with(data, i, data[i]._replace(opcode=chance.choice(OPCODES)))


def change_length(chance: Random, data: Records) -> Records:
    """Return the records, one of them longer or shorter; its length says so."""
    i = chance.randrange(len(data))
    body = data[i].body
    change = chance.choice((1, 4, 9, 100))
    longer = chance.random() < 0.5
    body = body + chance.randbytes(change) if longer else body[: max(0, len(body) - change)]
    return _with(data, i, data[i]._replace(body=body))


def change_chunk_head(chance: Random, data: Records) -> Records:
    """Return the records with an odd size, checksum, time or compression in a chunk's head."""
    i = _any_of(chance, data, CHUNK)
    if i is None:
        return change_time(chance, data)
    body = bytearray(data[i].body)
    at, code = chance.choice(((0, "Q"), (8, "Q"), (16, "Q"), (24, "I"), (28, "I")))
    odd = (0, 1, 100_000, 1 << 28, 1 << 31, (1 << 32) - 1, 1 << 40, 1 << 63)
    value = chance.choice(odd) % (1 << 8 * struct.calcsize(code))
    struct.pack_into(f"<{code}", body, at, value)
    return _with(data, i, data[i]._replace(body=bytes(body)))


def take_chunk_of_another_log(chance: Random, data: Records) -> Records:
    """Return the records, a chunk of them replaced by one of another log."""
    i = _any_of(chance, data, CHUNK)
    if i is None:
        return swap_records(chance, data)
    other = records_of(sound_log(chance.choice([name for name in FORMS if "loose" not in name])))
    return _with(data, i, chance.choice([record for record in other if record.opcode == CHUNK]))


def change_time(chance: Random, data: Records) -> Records:
    """Return the records with an odd log time of a message, or first time of a chunk."""
    i, at = _any_of(chance, data, MESSAGE), 6
    if i is None:
        i, at = _any_of(chance, data, CHUNK), 0
    if i is None:
        return data
    body = bytearray(data[i].body)
    struct.pack_into("<Q", body, at, chance.choice(ODD_TIMES))
    return _with(data, i, data[i]._replace(body=bytes(body)))


def change_declaration(chance: Random, data: Records) -> Records:
    """Return the records with a damaged byte in a schema or channel, or one of an odd number."""
    places = [i for i, record in enumerate(data) if record.opcode in DECLARATIONS]
    if not places:
        return change_inside_chunk(chance, data)
    i = chance.choice(places)
    return _with(data, i, _damaged(chance, data[i], min(40, len(data[i].body))))


def change_inside_chunk(chance: Random, data: Records) -> Records:
    """Return the records with damage inside an uncompressed chunk, whose checksum fits it."""
    i = _any_of(chance, data, CHUNK)
    if i is None:
        return change_opcode(chance, data)
    body = bytearray(data[i].body)
    start, end, size, _ = CHUNK_HEAD.unpack_from(body)
    if body[28:32] != bytes(4):
        return change_chunk_head(chance, data)
    at = 28 + 4 + 8
    for _ in range(chance.choice((1, 1, 3))):
        body[chance.randrange(at, len(body))] = chance.randrange(256)
    CHUNK_HEAD.pack_into(body, 0, start, end, size, zlib.crc32(body[at:]))
    return _with(data, i, data[i]._replace(body=bytes(body)))


def _with(data: Records, i: int, record: Record) -> Records:
    return [*data[:i], record, *data[i + 1 :]]


def _any_of(chance: Random, data: Records, opcode: int) -> int | None:
    places = [i for i, record in enumerate(data) if record.opcode == opcode]
    return chance.choice(places) if places else None


def _damaged(chance: Random, record: Record, within: int) -> Record:
    body = bytearray(record.body)
    body[chance.randrange(within)] = chance.randrange(256)
    return record._replace(body=bytes(body))


# After these the log still has all its messages: each must be read, or something said.
KEEPING: tuple[Callable[[Random, Records], Records], ...] = (
    swap_records, shuffle_records, repeat_record, move_record, remove_declaration,
    exchange_numbers, move_declarations, insert_empty_records,
)  # fmt: skip
DAMAGES: tuple[Callable[[Random, Records], Records], ...] = (
    *KEEPING, remove_record, change_opcode, change_length, change_chunk_head,
    take_chunk_of_another_log, change_time, change_declaration, change_inside_chunk,
)  # fmt: skip


def damage_records(how: Callable[[Random, Records], Records], chance: Random, log: bytes) -> bytes:
    """Return a log with damaged records in its data section, or in its summary.

    Mostly the footer is made anew, so that the summary counts for what it says.
    """
    data, summary = split(records_of(log))
    if chance.random() < 0.15 and len(summary) > 1:
        summary = [*how(chance, summary[:-1]), summary[-1]]
    else:
        last = -1 if chance.random() < 0.9 else len(data)  # the section's end stays, mostly
        data = [data[0], *how(chance, data[1:last]), *data[last:]]
    return joined(data, summary, remade=chance.random() < 0.85)

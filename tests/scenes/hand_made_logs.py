"""Logs of frames made by hand, record by record, and what a walk over their records finds."""

import struct
import zlib

from epipole.io.logs.mcap.container import MAGIC
from epipole.io.logs.mcap.records import RecordWalk
from scenes.log_bytes import log_bytes

SCHEMA = "epipole.CentroidFrame"
HEAD = struct.Struct("<BQ")


def schema_body(number=1, name=SCHEMA, data=b""):
    """Return the body of a schema."""
    text = name.encode()
    return (
        struct.pack("<HI", number, len(text))
        + text
        + bytes(4)
        + struct.pack("<I", len(data))
        + data
    )


def channel_body(number=1, schema=1, topic="/a", encoding="protobuf"):
    """Return the body of a channel."""
    body = struct.pack("<HH", number, schema)
    for text in (topic.encode(), encoding.encode()):
        body += struct.pack("<I", len(text)) + text
    return body + bytes(4)


SCHEMA_BODY, CHANNEL_BODY = schema_body(), channel_body()


def record(opcode, body):
    """Return a record."""
    return HEAD.pack(opcode, len(body)) + body


def message(i, channel=1):
    """Return a message whose data are a number, logged at 1000 + this number."""
    return record(5, struct.pack("<HIQQ", channel, 0, 1000 + i, 0) + struct.pack("<I", i))


def chunk(records):
    """Return a chunk that is not compressed."""
    head = struct.pack("<QQQI", 1000, 2000, len(records), zlib.crc32(records))
    return record(6, head + bytes(4) + struct.pack("<Q", len(records)) + records)


def hand_made(*records, summary=b"", checksum=0):
    """Return a log of these records of a data section; `checksum`: of the data section."""
    data = MAGIC + record(1, bytes(8)) + b"".join(records) + record(15, struct.pack("<I", checksum))
    footer = record(2, struct.pack("<QQI", len(data) if summary else 0, 0, 0))
    return data + summary + footer + MAGIC


DECLARED = record(3, SCHEMA_BODY) + record(4, CHANNEL_BODY)


def walk(data):
    """Return the numbers of the messages found, and the damage as (reason, count)."""
    walked = RecordWalk(log_bytes(bytes(data)), frozenset([SCHEMA]))
    found = [
        int(block.data[at : at + 4].view("<u4")[0])
        for block in walked.blocks()
        for at in block.start
    ]
    return found, [(d.reason, d.n) for d in walked.damage]

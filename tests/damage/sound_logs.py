"""Small sound logs of the example's first seconds, in every form that a recorder may write."""

import io
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from mcap.writer import CompressionType, IndexType, Writer
from scenes.altered_logs import frame_values, state_values, table_rows

from epipole.io.logs.messages.registry import encoding_named
from epipole.io.logs.reader import read_log
from epipole.io.logs.writer import calibration_values
from epipole.schemas.bridge import array
from epipole.schemas.log_messages import CALIBRATION, FRAME, STATE
from epipole.schemas.work_tables import LogContents

EXAMPLE = Path(__file__).parents[2] / "examples" / "four_sensor_geo.mcap"
SECONDS_NS = 8_000_000_000  # of the example that a log has
CHUNK_BYTES = 4096
ZSTD, LZ4, NONE = CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE
LOOSE = {"use_chunking": False}
NO_CRC = {"enable_crcs": False}
NO_SUMMARY = {
    "index_types": IndexType.NONE,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_statistics": False,
    "use_summary_offsets": False,
}


Key = tuple[str, str, int]  # of a message: kind, sensor, time


class Message(NamedTuple):
    """A message as the encodings write it."""

    kind: str
    values: dict[str, Any]

    @property
    def time_ns(self) -> int:
        """The time that is also the log time."""
        return int(self.values["timestamp"])

    @property
    def sensor_id(self) -> str:
        """The sensor that the message is of."""
        return str(self.values["frame_id" if self.kind == CALIBRATION else "sensor_id"])


class Form(NamedTuple):
    """How a log is written: the encoding of its messages, and options of the MCAP writer."""

    encoding: str
    compression: CompressionType = ZSTD
    options: dict[str, Any] = {}  # noqa: RUF012  never changed


FORMS = {
    "protobuf_zstd": Form("protobuf"),
    "protobuf_lz4": Form("protobuf", LZ4),
    "protobuf_none": Form("protobuf", NONE),
    "protobuf_none_without_crc": Form("protobuf", NONE, NO_CRC),
    "protobuf_zstd_without_summary": Form("protobuf", ZSTD, NO_SUMMARY),
    "protobuf_loose": Form("protobuf", NONE, LOOSE),
    "protobuf_loose_with_crc": Form("protobuf", NONE, LOOSE | {"enable_data_crcs": True}),
    "protobuf_loose_without_summary": Form("protobuf", NONE, LOOSE | NO_SUMMARY),
    "protobuf_none_with_data_crc": Form("protobuf", NONE, NO_CRC | {"enable_data_crcs": True}),
    "json_loose_with_crc": Form("json", NONE, LOOSE | {"enable_data_crcs": True}),
    "json_zstd": Form("json"),
    "json_none": Form("json", NONE),
    "json_loose": Form("json", NONE, LOOSE),
    "ros2_lz4": Form("ros2", LZ4),
    "ros2_none_without_crc": Form("ros2", NONE, NO_CRC),
}
NAMES = (*FORMS, "example")


@cache
def messages() -> tuple[Message, ...]:
    """Return the messages of the example's first seconds, in order of time."""
    log = read_log(EXAMPLE)
    found = []
    for row in table_rows(log.cameras):
        values = calibration_values(row["sensor_id"], row["time_ns"], row)
        found.append(Message(CALIBRATION, values))
    for kind, of, table in (
        (STATE, state_values, log.states),
        (FRAME, frame_values, log.exposures),
    ):
        for row in table_rows(table):
            values = of(row)
            found.append(Message(kind, {"timestamp": values.pop("time_ns"), **values}))
    found.sort(key=lambda message: (message.time_ns, message.kind))
    end_ns = found[0].time_ns + SECONDS_NS
    return tuple(message for message in found if message.time_ns < end_ns)


@cache
def sound_log(name: str) -> bytes:
    """Return a log by its name in `NAMES`."""
    if name == "example":
        return EXAMPLE.read_bytes()
    form = FORMS[name]
    encode = encoding_named(form.encoding).encode
    return written([(m, encode(m.kind, m.values)) for m in messages()], form)


@cache
def count(name: str) -> int:
    """Return how many messages a sound log has."""
    if name != "example":
        return len(messages())
    log = read_log(EXAMPLE)
    return sum(len(table) for table in (log.exposures, log.states, log.cameras))


@cache
def keys(name: str) -> frozenset[Key]:
    """Return what tells the messages of a sound log apart."""
    if name == "example":
        return keys_of(read_log(EXAMPLE))
    return frozenset((m.kind, m.sensor_id, m.time_ns) for m in messages())


def keys_of(log: LogContents) -> frozenset[Key]:
    """Return the kind, the sensor and the time of each message that was read."""
    tables = {FRAME: log.exposures, STATE: log.states, CALIBRATION: log.cameras}
    return frozenset(
        (kind, sensor_id, time_ns)
        for kind, table in tables.items()
        for sensor_id, time_ns in zip(
            table["sensor_id"].to_pylist(), array(table, "time").tolist(), strict=True
        )
    )


def written(encoded: list[tuple[Message, bytes]], form: Form) -> bytes:
    """Return a log of messages and their bytes."""
    encoding, out = encoding_named(form.encoding), io.BytesIO()
    writer = Writer(out, chunk_size=CHUNK_BYTES, compression=form.compression, **form.options)
    writer.start(profile=encoding.profile, library="damage")
    schemas: dict[str, int] = {}
    channels: dict[tuple[str, str], int] = {}
    for message, data in encoded:
        kind, key = message.kind, (message.sensor_id, message.kind)
        if kind not in schemas:
            name = encoding.schema_names[kind][0]
            schemas[kind] = writer.register_schema(
                name, encoding.schema_encoding, encoding.schema(kind)
            )
        if key not in channels:
            topic = "/" + "/".join(key)
            channels[key] = writer.register_channel(topic, encoding.message_encoding, schemas[kind])
        writer.add_message(channels[key], message.time_ns, data, message.time_ns)
    writer.finish()
    return out.getvalue()

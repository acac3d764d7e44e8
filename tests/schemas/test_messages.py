"""The declared messages against the contract and against other people's decoders."""

import json
import re
from pathlib import Path

import pytest
from google.protobuf import descriptor_pb2

from epipole.schemas.messages import (
    CALIBRATION_NAME,
    CENTROID_FRAME,
    SENSOR_STATE,
    json_schema,
    message_class,
    protobuf_schema,
    ros_definition,
    ros_schema,
)

CONTRACT = Path(__file__).resolve().parents[3] / "shared" / "contract"
MESSAGES = pytest.mark.parametrize("message", [CENTROID_FRAME, SENSOR_STATE])
PROTO_KINDS = {"time": "google.protobuf.Timestamp"}

needs_contract = pytest.mark.skipif(not CONTRACT.exists(), reason="the contract is not at hand")


@needs_contract
@MESSAGES
def test_fields_are_those_of_the_proto_file(message):
    text = (CONTRACT / "epipole.proto").read_text()
    body = re.search(rf"message {message.name.partition('.')[2]} {{(.*?)\n}}", text, re.S)[1]
    found = re.findall(r"^\s*(repeated )?([\w.]+) (\w+) = (\d+);", body, re.M)
    declared = [
        ("repeated " if m.repeated else "", PROTO_KINDS.get(m.kind, m.kind), m.name, str(m.number))
        for m in message.members
    ]
    assert found == declared


@needs_contract
@MESSAGES
def test_ros_fields_are_those_of_the_msg_file(message):
    text = (CONTRACT / f"{message.name.partition('.')[2]}.msg").read_text()
    fields = [line for line in text.splitlines() if not line.startswith("#")]
    assert ros_definition(message).splitlines()[1:] == fields


@pytest.mark.parametrize("name", [CENTROID_FRAME.name, SENSOR_STATE.name, CALIBRATION_NAME])
def test_a_protobuf_schema_holds_the_message_and_all_that_it_needs(name):
    files = descriptor_pb2.FileDescriptorSet.FromString(protobuf_schema(name)).file
    known = set()
    for file in files:  # dependencies first
        assert set(file.dependency) <= known
        known.add(file.name)
    package, _, short = name.rpartition(".")
    assert files[-1].package == package
    assert short in [m.name for m in files[-1].message_type]


@MESSAGES
def test_arrays_declared_as_bytes_are_the_packed_numbers(message):
    numbers = [m for m in message.members if m.repeated]
    whole = message_class(message.name)(**{m.name: [1.5, -2.0, 4.25] for m in numbers})
    raw = message_class(message.name, True).FromString(whole.SerializeToString())
    for member in numbers:
        assert len(getattr(raw, member.name)) == 3 * (4 if member.kind == "float" else 8)
    assert raw.SerializeToString() == whole.SerializeToString()


@MESSAGES
def test_a_json_schema_names_every_field(message):
    schema = json.loads(json_schema(message.name))
    assert list(schema["properties"]) == [m.name for m in message.members]


@MESSAGES
def test_a_ros_schema_defines_the_time_it_uses(message):
    text = ros_schema(message.ros_name).decode()
    assert "MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec" in text

"""An MCAP file for viewers: messages of foxglove's public schemas, as protobuf."""

import importlib
import os
from functools import cache
from typing import Any

from google.protobuf import descriptor_pb2

from epipole.io.logs.mcap_file import McapFile, Schema
from epipole.io.logs.messages.encodings.protobuf import add_file
from epipole.io.logs.messages.encodings.registry import encoding_named
from epipole.io.logs.writer import calibration_values
from epipole.schemas.logs.messages import CALIBRATION

PREFIX = "foxglove."


class ViewerFile(McapFile):
    """Writes messages by the name of their schema, such as ``foxglove.SceneUpdate``."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path)
        self._protobuf = encoding_named("protobuf")

    def message(self, topic: str, schema: str, time_ns: int, data: bytes) -> None:
        """Write a serialised message."""
        self.write(topic, foxglove_schema(schema), time_ns, data)

    def calibration(self, sensor_id: str, time_ns: int, camera: dict[str, Any]) -> None:
        """Write a calibration, of a row of CAMERAS."""
        data = self._protobuf.encode(CALIBRATION, calibration_values(sensor_id, time_ns, camera))
        self.message(f"/{sensor_id}/calibration", f"{PREFIX}CameraCalibration", time_ns, data)


@cache
def foxglove_schema(name: str) -> Schema:
    """Return one of the public schemas."""
    kind = name.removeprefix(PREFIX)
    module = importlib.import_module(f"foxglove_schemas_protobuf.{kind}_pb2")
    files = descriptor_pb2.FileDescriptorSet()
    add_file(files, getattr(module, kind).DESCRIPTOR.file)
    return Schema(name, "protobuf", files.SerializeToString(deterministic=True), "protobuf")

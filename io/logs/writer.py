"""Writing MCAP files: logs of sensors, and files for viewers."""

import contextlib
import errno
import importlib
import os
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple, Self

import numpy.typing as npt
from google.protobuf import descriptor_pb2
from mcap.writer import CompressionType, Writer

from epipole.io.logs.messages.encoding import Values
from epipole.io.logs.messages.protobuf import add_file
from epipole.io.logs.messages.registry import encoding_named
from epipole.schemas.log_messages import CALIBRATION, FRAME, STATE

# The container: channels, messages, and the file's name when it is complete.

COMPRESSIONS = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}


class Schema(NamedTuple):
    """The schema of a channel's messages, and how they are encoded."""

    name: str
    encoding: str
    data: bytes
    message_encoding: str


class McapFile:
    """Writes one file; a context manager. The file gets its name when it is complete.

    The bytes depend only on the messages and their order. `log_time` and `publish_time` are the
    time of the message.

    Raises
    ------
    ValueError
        Where the compression is unknown.
    OSError
        Where the path is that of a folder, or the file cannot be written.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        profile: str = "",
        compression: str = "zstd",
        chunk_size: int = 1 << 20,
    ) -> None:
        if compression not in COMPRESSIONS:
            raise ValueError(f"compression {compression!r}: not one of {', '.join(COMPRESSIONS)}")
        self._path = Path(path)
        if self._path.is_dir():  # refused before all is written; "" is the current folder
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
        self._partial = self._path.with_name(self._path.name + ".partial")
        self._file = self._partial.open("wb")
        self._writer = Writer(
            self._file, compression=COMPRESSIONS[compression], chunk_size=chunk_size
        )
        # The default library name has a version in it, which would change the bytes.
        self._writer.start(profile=profile, library="epipole")
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._sequences: dict[int, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self._abandon()

    def close(self) -> None:
        """Write the summary and give the file its name."""
        try:
            self._writer.finish()
            self._file.close()
            self._partial.replace(self._path)
        except BaseException:
            self._abandon()
            raise

    def _abandon(self) -> None:
        """Remove what was written; on a full disk the file cannot even be closed in order."""
        with contextlib.suppress(OSError):
            self._file.close()
        self._partial.unlink(missing_ok=True)

    def write(self, topic: str, schema: Schema, time_ns: int, data: bytes) -> None:
        """Write a message; the first of a topic opens its channel."""
        channel = self._channels.get((topic, schema.name)) or self._open(topic, schema)
        sequence = self._sequences[channel]
        self._sequences[channel] = sequence + 1
        self._writer.add_message(channel, time_ns, data, time_ns, sequence & 0xFFFFFFFF)

    def _open(self, topic: str, schema: Schema) -> int:
        if schema.name not in self._schemas:
            self._schemas[schema.name] = self._writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        channel = self._writer.register_channel(
            topic, schema.message_encoding, self._schemas[schema.name]
        )
        self._channels[(topic, schema.name)] = channel
        self._sequences[channel] = 0
        return channel


# Logs: frames, states and calibrations.

_TOPICS = {FRAME: "centroids", STATE: "state", CALIBRATION: "calibration"}
Numbers = npt.ArrayLike


class LogWriter:
    """Writes one log; a context manager. The file gets its name when it is complete.

    The bytes depend only on the messages and their order. Messages may come in any order of
    time; `log_time` and `publish_time` are the time of the message.

    Parameters
    ----------
    path
        The file to write.
    encoding
        A name in `messages.registry.ENCODINGS`, such as protobuf.
    compression
        Of chunks: zstd, lz4 or none.
    chunk_size
        Bytes in a chunk before compression.

    Raises
    ------
    ValueError
        Where the encoding or the compression is unknown.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        encoding: str = "protobuf",
        compression: str = "zstd",
        chunk_size: int = 1 << 20,
    ) -> None:
        self._encoding = encoding_named(encoding)
        self._file = McapFile(
            path, profile=self._encoding.profile, compression=compression, chunk_size=chunk_size
        )
        self._schemas: dict[str, Schema] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._file.__exit__(kind, error, trace)

    def close(self) -> None:
        """Write the summary and give the file its name."""
        self._file.close()

    def camera(self, sensor_id: str, time_ns: int, camera: Mapping[str, Any] | Any) -> None:
        """Write a calibration that holds from `time_ns` on.

        `camera` has width, height, fx_px, fy_px, cx_px, cy_px [px] and k1, k2, p1, p2, k3, as
        a mapping or as attributes; a fisheye has k1, k2, k3, k4 and `fisheye`, a rolling shutter
        `line_time_s`.
        """
        if not isinstance(camera, Mapping):
            names = ("width", "height", "fx_px", "fy_px", "cx_px", "cy_px", "k1", "k2", "k3")
            maybe = ("p1", "p2", "k4", "fisheye", "line_time_s")
            camera = {name: getattr(camera, name) for name in names} | {
                name: getattr(camera, name, 0.0) for name in maybe
            }
        self._write(CALIBRATION, time_ns, sensor_id, calibration_values(sensor_id, time_ns, camera))

    def state(
        self,
        sensor_id: str,
        time_ns: int,
        *,
        position_km: Numbers,
        velocity_km_s: Numbers | None = None,
        frame: str = "GCRF",
        position_sigma_km: float = 0.0,
        attitude_xyzw: Numbers | None = None,
        attitude_sigma_arcsec: float = 0.0,
    ) -> None:
        """Write a state: (3) position, (3) velocity and (4) attitude, sensor from GCRF."""
        values = {
            "timestamp": time_ns,
            "sensor_id": sensor_id,
            "frame": frame,
            "position_km": position_km,
            "velocity_km_s": velocity_km_s,
            "position_sigma_km": float(position_sigma_km),
            "attitude_xyzw": attitude_xyzw,
            "attitude_sigma_arcsec": float(attitude_sigma_arcsec),
        }
        self._write(STATE, time_ns, sensor_id, values)

    def frame(
        self,
        sensor_id: str,
        time_ns: int,
        *,
        frame_number: int,
        exposure_s: float,
        x_px: Sequence[float] | npt.NDArray[Any],
        y_px: Sequence[float] | npt.NDArray[Any],
        flux: Sequence[float] | npt.NDArray[Any] | None = None,
        sigma_px: Sequence[float] | npt.NDArray[Any] | None = None,
    ) -> None:
        """Write a frame; arrays of (n) centroids, `flux` and `sigma_px` where known.

        The arrays are written as given, equal in length or not: a simulator must be able to
        write the errors that a reader has to survive.
        """
        values = {
            "timestamp": time_ns,
            "sensor_id": sensor_id,
            "frame_number": int(frame_number),
            "exposure_s": float(exposure_s),
            "x_px": x_px,
            "y_px": y_px,
            "flux": flux,
            "sigma_px": sigma_px,
        }
        self._write(FRAME, time_ns, sensor_id, values)

    def _write(self, kind: str, time_ns: int, sensor_id: str, values: Values) -> None:
        data = self._encoding.encode(kind, values)
        schema = self._schemas.get(kind) or self._schema(kind)
        self._file.write(f"/{sensor_id}/{_TOPICS[kind]}", schema, time_ns, data)

    def _schema(self, kind: str) -> Schema:
        encoding = self._encoding
        schema = Schema(
            encoding.schema_names[kind][0],
            encoding.schema_encoding,
            encoding.schema(kind),
            encoding.message_encoding,
        )
        self._schemas[kind] = schema
        return schema


def distortion_of(camera: Values) -> tuple[str, list[float]]:
    """Return the distortion model of a calibration message, and its coefficients D.

    A fisheye's is Foxglove's `kannala_brandt`, which has no tangential terms.
    """
    fisheye = bool(camera.get("fisheye", False))
    names = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    return "kannala_brandt" if fisheye else "plumb_bob", [float(camera[n]) for n in names]


def calibration_values(sensor_id: str, time_ns: int, camera: Values) -> dict[str, Any]:
    """Return a camera as the values of a calibration message; see `LogWriter.camera`."""
    fx, fy, cx, cy = (float(camera[n]) for n in ("fx_px", "fy_px", "cx_px", "cy_px"))
    model, coefficients = distortion_of(camera)
    line_time_s = float(camera.get("line_time_s", 0.0))
    values = {
        "timestamp": time_ns,
        "frame_id": sensor_id,
        "width": int(camera["width"]),
        "height": int(camera["height"]),
        "distortion_model": model,
        "D": coefficients,
        "K": [fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0],
        "R": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        "P": [fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
    return values | ({"line_time_s": line_time_s} if line_time_s else {})


# Files for viewers: foxglove's public schemas, as protobuf.

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

"""Logs out: frames, states and calibrations to an MCAP file."""

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy.typing as npt
from mcap.writer import CompressionType, Writer

from epipole.io.logs.messages.encoding import (
    encode_calibration,
    encode_cdr,
    encode_json,
    encode_protobuf,
)
from epipole.schemas import messages
from epipole.schemas.messages import CENTROID_FRAME, SENSOR_STATE, MessageType

COMPRESSIONS = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}
# The message encoding, the schema encoding, and how a message becomes bytes.
ENCODINGS = {
    "protobuf": ("protobuf", "protobuf", encode_protobuf),
    "json": ("json", "jsonschema", encode_json),
    "ros2": ("cdr", "ros2msg", encode_cdr),
}
_TOPICS = {
    messages.FRAME: "centroids",
    messages.STATE: "state",
    messages.CALIBRATION: "calibration",
}
Numbers = npt.ArrayLike


class LogWriter:
    """Writes one log; a context manager. The file appears under its name when it is whole.

    The bytes depend on the messages and their order alone, not on the clock. Messages may
    come in any order of time; `log_time` and `publish_time` are a message's own time.

    Parameters
    ----------
    path
        The file to write.
    encoding
        protobuf, json or ros2.
    compression
        Of chunks: zstd, lz4 or none.
    chunk_size
        Bytes in a chunk before compression.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        *,
        encoding: str = "protobuf",
        compression: str = "zstd",
        chunk_size: int = 1 << 20,
    ) -> None:
        if encoding not in ENCODINGS:
            raise ValueError(f"encoding {encoding!r} is none of {', '.join(ENCODINGS)}")
        if compression not in COMPRESSIONS:
            raise ValueError(f"compression {compression!r} is none of {', '.join(COMPRESSIONS)}")
        self._encoding, self._schema_encoding, self._encode = ENCODINGS[encoding]
        self._path = Path(path)
        self._partial = self._path.with_name(self._path.name + ".partial")
        self._file = self._partial.open("wb")
        self._writer = Writer(
            self._file, compression=COMPRESSIONS[compression], chunk_size=chunk_size
        )
        # Not the library's own name, which carries its version into the bytes.
        self._writer.start(profile="ros2" if encoding == "ros2" else "", library="epipole")
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
            self._file.close()
            self._partial.unlink(missing_ok=True)

    def close(self) -> None:
        """Write the summary and give the file its name."""
        self._writer.finish()
        self._file.close()
        self._partial.replace(self._path)

    def camera(self, sensor_id: str, time_ns: int, camera: Mapping[str, Any] | Any) -> None:
        """Write a calibration that holds from `time_ns` on.

        `camera` has width, height, fx_px, fy_px, cx_px, cy_px [px] and k1, k2, p1, p2, k3, as
        a mapping or as attributes.
        """
        if not isinstance(camera, Mapping):
            names = ("width", "height", "fx_px", "fy_px", "cx_px", "cy_px")
            camera = {
                name: getattr(camera, name) for name in (*names, "k1", "k2", "p1", "p2", "k3")
            }
        data = encode_calibration(self._encoding, sensor_id, time_ns, camera)
        self._write(messages.CALIBRATION, sensor_id, time_ns, data)

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
        """Write a state: (3) position, (3) velocity and (4) attitude, sensor from ICRS."""
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
        self._write(messages.STATE, sensor_id, time_ns, self._encode(SENSOR_STATE, values))

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

        The arrays are written as they come, equal in length or not: a simulator must be able
        to make the damage that a reader is to survive.
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
        self._write(messages.FRAME, sensor_id, time_ns, self._encode(CENTROID_FRAME, values))

    def _write(self, carries: str, sensor_id: str, time_ns: int, data: bytes) -> None:
        channel = self._channels.get((carries, sensor_id)) or self._open(carries, sensor_id)
        sequence = self._sequences[channel]
        self._sequences[channel] = sequence + 1
        self._writer.add_message(channel, time_ns, data, time_ns, sequence & 0xFFFFFFFF)

    def _open(self, carries: str, sensor_id: str) -> int:
        message: MessageType | None = messages.OWN_MESSAGES.get(carries)
        if self._encoding == "cdr":
            name = message.ros_name if message else messages.CAMERA_INFO_NAME
            text = messages.ros_schema(name)
        else:
            name = message.name if message else messages.CALIBRATION_NAME
            as_json = self._encoding == "json"
            text = messages.json_schema(name) if as_json else messages.protobuf_schema(name)
        if name not in self._schemas:
            self._schemas[name] = self._writer.register_schema(name, self._schema_encoding, text)
        channel = self._writer.register_channel(
            f"/{sensor_id}/{_TOPICS[carries]}", self._encoding, self._schemas[name]
        )
        self._channels[(carries, sensor_id)] = channel
        self._sequences[channel] = 0
        return channel

"""The layout of the work folder: where each part lies; `parts` declares its tables.

Parts of reading belong to a run; all others to the nights and a key (see `folder`):

    read/log-0/piece-0            the content of one piece of a log
    read/sensor-0                 a sensor's frames in order of time, and its states

    identify/0/1554091200         sensor 0, the span that begins at this second since 1970
    calibrate/0/0/1554091200      identified again, with a camera that was searched for
    calibrate/1/0/1554091200      the same, with the optics of the first calibration
    check/1/0/1554091200          frames at their true times, from the first check on
    track/0/0/1554091200          tracklets of the span, before any check
    track/0/0-names/1554091200    the names of these tracklets in the night
    track/0/0-names/night         all tracklets of the sensor's night
    solve/0/views/0/1554091200    views of sensor 0, before any check
    solve/0/all/...               of all sensors; solve/0/some/... without those left out;
                                  others for each set of errors that are added:
        blocks/1554091200         objects of the block of time that begins at this second
        objects/1554091200        the objects of the span, each with its views and its piece
        errors/1554091200         sensors whose shared errors are larger than stated
        pieces/1554091200/0       positions and states of some of the objects
        linked_objects/...        spans in which orbits join more tracklets to objects, and the
        linked_pieces/...         pieces of these objects
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple
from zlib import crc32

import pyarrow as pa

from epipole.io.work.parts import Parts, read_part
from epipole.schemas.bridge import concat
from epipole.schemas.spans import Sensor, Span
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import SHARED_ERRORS


class SensorFault(NamedTuple):
    """A fault of a sensor that takes part; errors are 1-sigma per axis.

    km, rad
        Errors of its positions and attitudes as large as the fault, as logs have them.
    bias_km, bias_rad
        Errors that are known, reported minus true, GCRF; the second is a rotation vector.
    left_km, left_rad
        Errors that are left where these are taken off.
    """

    sensor_id: str
    km: float = 0.0
    rad: float = 0.0
    bias_km: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bias_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)
    left_km: float = 0.0
    left_rad: float = 0.0


class AddedErrors(NamedTuple):
    """Errors with which sensors take part beside the stated ones.

    km
        Of the positions of all sensors, 1-sigma per axis.
    faults
        Of some sensors.
    """

    km: float = 0.0
    faults: tuple[SensorFault, ...] = ()

    def of(self, sensor_id: str) -> SensorFault:
        """Return the fault of a sensor, with `km` in its errors; a sound one has only these."""
        found = {fault.sensor_id: fault for fault in self.faults}
        fault = found.get(sensor_id, SensorFault(sensor_id))
        return fault._replace(
            km=math.hypot(self.km, fault.km), left_km=math.hypot(self.km, fault.left_km)
        )

    @property
    def label(self) -> str:
        """A part of the name of a folder; other errors have another one."""
        whole = f"-{self.km:g}-km" if self.km else ""
        return whole + (f"-{crc32(repr(self.faults).encode()):08x}" if self.faults else "")


NOTHING_ADDED = AddedErrors()


class ReadFolder(NamedTuple):
    """Where reading puts the content of a run's logs.

    `day` is the night that is made, in days since 1970: frames are numbered by it where a counter
    restarted. None: each by the UTC date of its time.
    """

    root: Path
    day: int | None = None

    def piece(self, log: int, piece: int) -> Path:
        """Return the part of one piece of a log: `LOG_PIECE`."""
        return self.root / Stage.READ / f"log-{log}" / f"piece-{piece}"

    def sensor(self, number: int) -> Path:
        """Return the part of a sensor: `READ_SENSOR`, the index of its frames and its states."""
        return self.root / Stage.READ / f"sensor-{number}"


class WorkFolder(NamedTuple):
    """Where the stages after reading put their parts.

    A round is one pass from `track` to `check`. After a correction of clocks comes another round.
    `kept` is the folder of the parts of other runs, by key; None: there are none.
    """

    root: Path
    kept: Path | None = None

    def identified(self, sensor: Sensor) -> Parts:
        """Return the parts of `identify`: `IDENTIFIED`."""
        return Parts(self.root / Stage.IDENTIFY / str(sensor.number), self.kept)

    def identified_again(self, sensor: Sensor, calibration: int) -> Parts:
        """Return the parts identified with the optics of a calibration, from 1, or with a camera
        that was searched for (0): `IDENTIFIED`."""
        return Parts(self.root / Stage.CALIBRATE / str(calibration) / str(sensor.number), self.kept)

    def corrected(self, sensor: Sensor, round_: int) -> Parts:
        """Return the parts with frames at their true times: `IDENTIFIED`."""
        return Parts(self.root / Stage.CHECK / str(round_) / str(sensor.number))

    def tracked(self, sensor: Sensor, round_: int) -> Parts:
        """Return the parts of `track`: `TRACKED`, with the tracklets' names in the span."""
        return Parts(self.root / Stage.TRACK / str(round_) / str(sensor.number), self.kept)

    def tracklet_names(self, sensor: Sensor, round_: int) -> Parts:
        """Return the parts with names in the night: `SPAN_NAMES`, and `NIGHT_TRACKLETS`."""
        return Parts(self.root / Stage.TRACK / str(round_) / f"{sensor.number}-names")

    def viewed(self, round_: int) -> "ViewedParts":
        """Return the parts with the views of all sensors."""
        return ViewedParts(self.root / Stage.SOLVE / str(round_) / "views", self.kept)

    def solved(
        self, round_: int, all_sensors: bool = True, added: AddedErrors = NOTHING_ADDED
    ) -> "SolvedParts":
        """Return the parts of `solve`: of all sensors, or without those left out."""
        which = ("all" if all_sensors else "some") + added.label
        return SolvedParts(self.root / Stage.SOLVE / str(round_) / which, added, self.kept)


@dataclass(frozen=True)
class ViewedParts:
    """The views of sensors, by their numbers in the run: `VIEWED`."""

    root: Path
    kept: Path | None = None

    def __getitem__(self, number: int) -> Parts:
        """Return the parts of a sensor."""
        return Parts(self.root / str(number), self.kept)


class SolvedParts(NamedTuple):
    """Where `solve` puts what it finds of the objects of all sensors.

    Sensors have the errors `added` beside the stated ones. With `linked`, parts are of objects with
    the tracklets that an orbit joins to them; pieces in which it joins none are those of before.
    """

    root: Path
    added: AddedErrors = NOTHING_ADDED
    kept: Path | None = None  # the folder of the parts of other runs, by key
    linked: bool = False

    def with_links(self) -> "SolvedParts":
        """Return where the objects go that an orbit joins more tracklets to."""
        return self._replace(linked=True)

    @property
    def blocks(self) -> Parts:
        """The objects of each block of time: `ASSOCIATED`."""
        return Parts(self.root / "blocks", self.kept)

    @property
    def objects(self) -> Parts:
        """The objects of each span, numbered through the night: `NUMBERED`."""
        return Parts(self.root / ("linked_objects" if self.linked else "objects"))

    @property
    def errors(self) -> Parts:
        """The sensors of each span whose shared errors are larger than stated: `JUDGED`."""
        return Parts(self.root / "errors", self.kept)

    def shared_errors(self, span: Span) -> pa.Table:
        """Return SHARED_ERRORS of a span; empty where no sensor's are larger than stated."""
        read = [self.errors.read(span, "errors")] if self.errors.holds(span) else []
        return concat(SHARED_ERRORS, read)

    def piece(self, span: Span, piece: int) -> Path:
        """Return the part of some objects of a span: `SOLVED`."""
        folder = "linked_pieces" if self.linked else "pieces"
        return self.root / folder / span.folder / str(piece)

    def holds(self, span: Span) -> bool:
        """Return whether the objects of the span are known, be it none."""
        return self._replace(linked=False).objects.holds(span)

    def pieces(self, span: Span) -> list[Path]:
        """Return the parts of a span's pieces, in order."""
        folders = [self.root / "pieces", self.root / "linked_pieces"][: 1 + self.linked]
        parts = [part for each in folders for part in (each / span.folder).glob("[0-9]*")]
        newest = {int(part.name): part for part in parts}
        return [newest[number] for number in sorted(newest)]

    def of_blocks(self, span: Span, name: str) -> list[pa.Table]:
        """Return a table of each block of a span."""
        return [self.blocks.read(block, name) for block in span.blocks if self.blocks.holds(block)]

    def read(self, span: Span, name: str, columns: Sequence[str] | None = None) -> list[pa.Table]:
        """Return a table of each piece of a span."""
        return [read_part(part, name, columns) for part in self.pieces(span)]


class SensorParts(NamedTuple):
    """The parts of one sensor that the later stages read."""

    sensor_id: str
    identified: Parts
    tracked: Parts
    names: Parts
    viewed: Parts

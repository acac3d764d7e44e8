"""The layout of the work folder: where each part lies; `part_tables` has what it holds.

Parts of reading belong to a run; all others to the nights and a key (see `folder`):

    read/log-0/piece-0            the content of one piece of a log
    read/sensor-0                 a sensor's frames in order of time, and its states

    identify/0/1554091200         sensor 0, the span that begins at this second since 1970
    calibrate/1/0/1554091200      identified again, with the optics of the first calibration
    check/1/0/1554091200          frames at their true times, from the first check on
    track/0/0/1554091200          tracklets of the span, before any check
    track/0/0-names/1554091200    the names of these tracklets in the night
    track/0/0-names/night         all tracklets of the sensor's night
    solve/0/all/1554091200        objects of the span, before any check
    solve/0/some/1554091200       the same without the sensors that the check left out
"""

from pathlib import Path
from typing import NamedTuple

from epipole.io.work.parts import Parts
from epipole.schemas.spans import Sensor
from epipole.schemas.stages import Stage


class ReadFolder(NamedTuple):
    """Where reading puts the content of a run's logs."""

    root: Path

    def piece(self, log: int, piece: int) -> Path:
        """Return the part of one piece of a log: `LOG_PIECE`."""
        return self.root / Stage.READ / f"log-{log}" / f"piece-{piece}"

    def sensor(self, number: int) -> Path:
        """Return the part of a sensor: `READ_SENSOR`, the index of its frames and its states."""
        return self.root / Stage.READ / f"sensor-{number}"


class WorkFolder(NamedTuple):
    """Where the stages after reading put their parts.

    A round is one pass from `track` to `check`. After a correction of clocks comes another round.
    """

    root: Path

    def identified(self, sensor: Sensor) -> Parts:
        """Return the parts of `identify`: `IDENTIFIED`."""
        return Parts(self.root / Stage.IDENTIFY / str(sensor.number))

    def identified_again(self, sensor: Sensor, calibration: int) -> Parts:
        """Return the parts identified with the optics of calibration 1 or 2: `IDENTIFIED`."""
        return Parts(self.root / Stage.CALIBRATE / str(calibration) / str(sensor.number))

    def corrected(self, sensor: Sensor, round_: int) -> Parts:
        """Return the parts with frames at their true times: `IDENTIFIED`."""
        return Parts(self.root / Stage.CHECK / str(round_) / str(sensor.number))

    def tracked(self, sensor: Sensor, round_: int) -> Parts:
        """Return the parts of `track`: `TRACKED`, with the tracklets' names in the span."""
        return Parts(self.root / Stage.TRACK / str(round_) / str(sensor.number))

    def tracklet_names(self, sensor: Sensor, round_: int) -> Parts:
        """Return the parts with names in the night: `SPAN_NAMES`, and `NIGHT_TRACKLETS`."""
        return Parts(self.root / Stage.TRACK / str(round_) / f"{sensor.number}-names")

    def solved(self, round_: int, all_sensors: bool = True) -> Parts:
        """Return the parts of `solve`, `SOLVED`: of all sensors, or without those left out."""
        return Parts(self.root / Stage.SOLVE / str(round_) / ("all" if all_sensors else "some"))


class SensorParts(NamedTuple):
    """The parts of one sensor that the later stages read."""

    identified: Parts
    tracked: Parts
    names: Parts

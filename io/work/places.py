"""The layout of the work folder: which part lies where.

What was read is named by the run, everything else by the night and a key (see `folder`):

    read/log-0/piece-0            what one piece of a log holds
    read/sensor-0                 a sensor's frames in order of time, and its states

    identify/0/1554091200         sensor 0, the span that begins then
    calibrate/1/0/1554091200      identified again, with the optics of the first calibration
    check/1/0/1554091200          frames at their true times, from the first check on
    track/0/0/1554091200          tracklets of the span, before any check
    track/0/0-names/1554091200    what they are called in the night
    solve/0/all/1554091200        objects of the span, before any check
    solve/0/some/1554091200       the same without the sensors that the check left out
"""

from pathlib import Path
from typing import NamedTuple

from epipole.io.work.parts import Parts
from epipole.schemas.spans import Sensor
from epipole.schemas.stages import Stage


class ReadFolder(NamedTuple):
    """Where reading leaves what the logs of a run hold."""

    root: Path

    def piece(self, log: int, piece: int) -> Path:
        """Return the part of one piece of a log: `exposures`, `states`, `cameras`, `rejects`."""
        return self.root / Stage.READ / f"log-{log}" / f"piece-{piece}"

    def sensor(self, number: int) -> Path:
        """Return the part of a sensor: the `index` of its frames, and its `states`."""
        return self.root / Stage.READ / f"sensor-{number}"


class WorkFolder(NamedTuple):
    """Where the stages after reading leave their parts.

    A round is one pass from `track` to `check`; the check may ask for another.
    """

    root: Path

    def identified(self, sensor: Sensor) -> Parts:
        """Return the parts of `identify`: `solutions`, `stars`, `detections`, `rejects`."""
        return Parts(self.root / Stage.IDENTIFY / str(sensor.number))

    def identified_again(self, sensor: Sensor, calibration: int) -> Parts:
        """Return the same, made with the optics of a calibration (1, 2)."""
        return Parts(self.root / Stage.CALIBRATE / str(calibration) / str(sensor.number))

    def corrected(self, sensor: Sensor, round_: int) -> Parts:
        """Return the same, with frames at their true times."""
        return Parts(self.root / Stage.CHECK / str(round_) / str(sensor.number))

    def tracked(self, sensor: Sensor, round_: int) -> Parts:
        """Return the parts of `track`: `detections` and `tracklets`, named within the span."""
        return Parts(self.root / Stage.TRACK / str(round_) / str(sensor.number))

    def tracklet_names(self, sensor: Sensor, round_: int) -> Parts:
        """Return what tracklets are called in the night: `names`, of the night `tracklets`."""
        return Parts(self.root / Stage.TRACK / str(round_) / f"{sensor.number}-names")

    def solved(self, round_: int, all_sensors: bool = True) -> Parts:
        """Return the parts of `solve`, of all sensors or without those that were left out."""
        return Parts(self.root / Stage.SOLVE / str(round_) / ("all" if all_sensors else "some"))


class SensorParts(NamedTuple):
    """The parts of one sensor that the later stages read."""

    identified: Parts
    tracked: Parts
    names: Parts

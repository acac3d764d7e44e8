"""The doctor: what is sound in logs, what is wrong, and what logs alone cannot show."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import pyarrow as pa

from epipole.flows.night.log_choice import find_logs
from epipole.flows.night.summary import many
from epipole.io.caches.private_folders import temporary_folder
from epipole.io.work.work_layout import ReadFolder
from epipole.schemas.bridge import concat
from epipole.schemas.errors import LogError
from epipole.schemas.log_checks import CheckVerdict, mistakes
from epipole.schemas.rejects import left_out
from epipole.schemas.settings import EVERY_SENSOR, Settings
from epipole.schemas.spans import ALL_TIME
from epipole.schemas.tables import REJECTS
from epipole.tasks.common.batches import Batch
from epipole.tasks.read.judge_logs import judge_logs, judged_sensors
from epipole.tasks.read.order_frames import OrderedFrames, order_logs, states_between
from epipole.tasks.read.read_logs import read_log_into

# Mistakes that states and frames can never show. A run shows some of them by lines of sight.
NOT_SHOWN = (
    "the time scale, if frames and states have the same wrong one",
    "GCRF, EME2000 or TEME, and axes exchanged or negated in states that do not turn with the "
    "Earth",
    "an error of the ephemeris that all its states share",
    "whether times are those of the start, the middle or the end of an exposure",
    "whose ephemeris it is",
)


class Diagnosis(NamedTuple):
    """What the doctor found.

    `checks` are CHECKS of all sensors; `logs`, `frames` and `states` count what was read.
    `left_out` has a sentence for each reason why something was left out. `assumed_in_vain` are
    sensors of the setting `sensors.assume` that these logs do not have.
    """

    checks: pa.Table
    logs: int
    frames: int
    states: int
    left_out: list[str]
    assumed_in_vain: list[str]

    @property
    def mistakes(self) -> list[str]:
        """A sentence for each mistake."""
        return mistakes(self.checks.to_pylist())

    @property
    def is_sound(self) -> bool:
        """Whether there is no mistake, and nothing was left out."""
        return not self.mistakes and not self.left_out


def doctor(logs: Sequence[str], settings: Settings = Settings()) -> Diagnosis:  # noqa: B008
    """Return what is wrong in logs, as a run reads them.

    Parameters
    ----------
    logs
        MCAP files, folders, globs or URLs of them.

    Raises
    ------
    LogError
        Where a file is not a log, or the logs have neither frames nor states.
    """
    given = find_logs(logs, None)
    with temporary_folder("doctor") as path:
        folder = ReadFolder(path)
        read = [
            read_log_into(folder, k, log, settings.sensors.assume)
            for k, log in enumerate(given.paths)
        ]
        frames = order_logs(folder, read, settings.sensors)
        rejects = concat(REJECTS, [given.rejects, frames.rejects])
        if not frames.sensors and not left_out(rejects):
            raise LogError(
                f"{', '.join(given.paths)}: neither frames nor states in these logs; "
                "check the recording"
            )
        known = {EVERY_SENSOR, *frames.sensors, *frames.cameras["sensor_id"].to_pylist()}
        checks = judge_logs.fn(
            Batch(judged_sensors(frames)), frames.cameras, rejects, ALL_TIME,
            settings.sensors.state_gap_s,
        )  # fmt: skip
        return Diagnosis(
            checks,
            len(given.paths),
            frames.n_frames,
            sum(_n_states(frames, number) for number in range(len(frames.sensors))),
            left_out(rejects),
            sorted({each.sensor for each in settings.sensors.assume} - known),
        )


def _n_states(frames: OrderedFrames, number: int) -> int:
    return int(states_between(frames.folder, number, *ALL_TIME).num_rows)


def as_dict(found: Diagnosis) -> dict[str, Any]:
    """Return a diagnosis for JSON."""
    return {
        "sound": found.is_sound,
        "mistakes": found.mistakes,
        "left_out": found.left_out,
        "assumed_in_vain": found.assumed_in_vain,
        "logs": found.logs,
        "frames": found.frames,
        "states": found.states,
        "checks": found.checks.to_pylist(),
        "not_shown": list(NOT_SHOWN),
    }


def lines(found: Diagnosis) -> list[str]:
    """Return a diagnosis as lines of text: of each sensor, what is wrong comes first."""
    out = [f"{many(found.frames, 'frame')} and {many(found.states, 'state')} "
           f"in {many(found.logs, 'log')}"]  # fmt: skip
    if found.assumed_in_vain:
        names = ", ".join(found.assumed_in_vain)
        out.append(f"assumed of {names}, of which these logs have nothing: check the id")
    rows = found.checks.to_pylist()
    for sensor in sorted({row["sensor_id"] for row in rows}):
        out.append(sensor)
        of_sensor = [row for row in rows if row["sensor_id"] == sensor]
        for verdict in (CheckVerdict.WRONG, CheckVerdict.UNKNOWN, CheckVerdict.SOUND):
            out += [
                f"  {verdict.value:<8} {row['check']:<16} {row['sentence']}"
                for row in of_sensor
                if row["verdict"] == verdict
            ]
    out += [
        "not shown by states and frames (a run compares lines of sight too):",
        *(f"  {each}" for each in NOT_SHOWN),
    ]
    if found.left_out:
        out += ["left out, with rows in `rejects`:", *(f"  {each}" for each in found.left_out)]
    wrong = found.mistakes
    if not wrong:
        return [*out, "no mistake found"]
    return [*out, f"{many(len(wrong), 'mistake')}:", *(f"  {each}" for each in wrong)]

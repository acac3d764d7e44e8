"""Doubt: how a night is solved again where sensors disagree.

If it is clear which sensors are wrong, their faults are taken off, or they are left out.

Sensors that agree with each other may be the wrong ones. So if no majority agrees, or several sets
of faults explain the lines of sight equally well, no sensor is left out. The positions of all
sensors get an error as large as the disagreement. The night is solved with it, and the covariances
of the objects contain it.
"""

import logging
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
import pyarrow.compute as pc

from epipole.flows.night.stages import Checked, check, solve
from epipole.flows.night.summary import many
from epipole.flows.night.work import Work
from epipole.io.work.work_layout import AddedErrors, SensorFault, SolvedParts
from epipole.schemas.bridge import array
from epipole.schemas.rejects import Reason
from epipole.schemas.settings import Settings
from epipole.tasks.algorithms.constants import SECOND_NS
from epipole.tasks.algorithms.sensor_faults.fault_judgement import LEAST_AGREEING, SOUND, Doubt
from epipole.tasks.check.check_sensors import SPEED_KM_S, SensorVerdict, add_faults

LOGGER = logging.getLogger(__name__)

MAX_ROUNDS = 3  # of judging without the faults found so far; two faults of seven sensors took two
WIDE_KM = 10.0  # error with which all sensors take part, to learn how far they disagree
# Factor on the spread of the sensors about their mean: if half of them share an error, the mean is
# off by as much. With 1, half of the positions were then outside their 99 % ellipsoids; with 2 and
# 3, none.
MARGIN = 2.0
# Minimum log odds that errors of all sensors are larger than stated. Sound scenes have up to 1.4.
MIN_LOG_ODDS = 6.0


class Settled(NamedTuple):
    """A night that is solved. Without `doubt`, it is clear which sensors are wrong, if any.

    `clocks` are the verdicts on wrong clocks, whether they were corrected or not.
    """

    work: Work
    solved: SolvedParts
    doubt: Doubt | None = None
    clocks: tuple[SensorVerdict, ...] = ()


class Sides(NamedTuple):
    """Sensors by what became of their tracklets.

    `disagree`: more are left out than in objects. Of the other sensors, `agree`: some are in
    objects; `unclear`: more are undecided than in objects.
    """

    agree: set[str]
    disagree: set[str]
    unclear: set[str]


class Attempt(NamedTuple):
    """A solution of a night, its check, and which sensors agree in it."""

    solved: SolvedParts
    checked: Checked
    sides: Sides

    @property
    def verdicts(self) -> tuple[SensorVerdict, ...]:
        """The verdicts of the check."""
        return self.checked.work.verdicts

    def in_doubt(self) -> bool:
        """Return whether it is not clear which sensors are wrong.

        It is clear if no sensor disagrees, or those that agree are a majority. Wrong clocks count
        on neither side: the states of the same sensor show them, without other sensors.
        """
        doubt, left_out = self.checked.doubt, self.checked.left_out
        if doubt.undecided or np.isfinite(doubt.shared_s) or doubt.spread_log_odds > MIN_LOG_ODDS:
            return True
        late = {verdict.sensor_id for verdict in _clocks(self.verdicts)}
        faulty = {name for name, why in left_out.items() if why != Reason.CLOCK_OFF}
        agree = self.sides.agree - left_out.keys() - late
        disagree = (self.sides.disagree - late) | faulty
        return bool(disagree) and len(agree) < max(len(disagree) + 1, LEAST_AGREEING)


def settle(work: Work, solved: SolvedParts, checked: Checked, settings: Settings) -> Settled:
    """Solve a night again where sensors are at fault, or in doubt.

    `work` and `solved` are of the last round of `track` and `solve`, `checked` is their check.
    """
    first = Attempt(solved, checked, sides_of(work, solved, settings.association.window_s))
    if not first.in_doubt():
        judged = _judge_left_out(work, first, settings)
        if (settled := _solve_with_faults(work, solved, judged, settings)) is not None:
            return settled
    wide = _attempt(work, settings, AddedErrors(WIDE_KM))
    if wide.checked.left_out and not wide.in_doubt():
        settled = _solve_with_faults(work, wide.solved, wide.checked, settings)
        if settled is not None:
            return settled
    more_km = _error_km(checked.doubt, wide.checked.doubt)
    LOGGER.warning(
        "sensors disagree, and who is wrong is not clear: an error of %.2g km per axis is added "
        "to the positions of all %s", more_km, many(len(work.spans), "sensor"),
    )  # fmt: skip
    unnamed = tuple(verdict._replace(cause=SOUND) for verdict in wide.verdicts)
    solved = solve(work, settings, added=AddedErrors(more_km))
    work = wide.checked.work._replace(verdicts=unnamed)
    return Settled(work, solved, wide.checked.doubt, _clocks(wide.verdicts))


def _attempt(
    work: Work,
    settings: Settings,
    added: AddedErrors,
    left_out: Mapping[str, Reason] | None = None,
) -> Attempt:
    """Solve and check a night with added errors, and without some sensors."""
    solved = solve(work, settings, left_out, added)
    checked = check(work, solved, settings, correct=False)
    return Attempt(solved, checked, sides_of(work, solved, settings.association.window_s))


def _judge_left_out(work: Work, first: Attempt, settings: Settings) -> Checked:
    """Return a check that also judges sensors that are too wrong to join objects.

    They take part with a wide error, as do sensors left out. If other sensors are at fault then, or
    it is not clear which, the check of the `first` attempt is returned.
    """
    checked = first.checked
    named = {verdict.sensor_id for verdict in first.verdicts if verdict.is_faulty}
    apart = (first.sides.disagree | first.sides.unclear) - named
    if not apart:
        return checked
    suspects = sorted(apart | set(checked.left_out))
    faults = tuple(SensorFault(name, WIDE_KM, left_km=WIDE_KM) for name in suspects)
    wide = _attempt(work, settings, AddedErrors(faults=faults))
    faulty = {verdict.sensor_id for verdict in wide.verdicts if verdict.is_faulty}
    is_consistent = (
        faulty <= named.union(suspects) and wide.checked.left_out.keys() >= checked.left_out.keys()
    )
    return wide.checked if is_consistent and not wide.in_doubt() else checked


def _solve_with_faults(
    work: Work, solved: SolvedParts, checked: Checked, settings: Settings
) -> Settled | None:
    """Solve a night without the faults of its sensors, until no other is found; None in doubt.

    Sensors whose fault is unknown or too large are left out. A fault may hide another one: so the
    sensors are judged again after each solution. Parameters are those of `settle`.
    """
    left_out: dict[str, Reason] = {}
    verdicts = checked.work.verdicts
    for _ in range(MAX_ROUNDS):
        faults = tuple(f for verdict in verdicts if (f := verdict.fault()) is not None)
        taking_part = {fault.sensor_id for fault in faults}
        left_out |= {name: why for name, why in checked.left_out.items() if name not in taking_part}
        if not (checked.left_out or faults):
            break
        again = _attempt(work, settings, AddedErrors(faults=faults), left_out)
        if again.in_doubt():
            return None
        solved, checked = again.solved, again.checked
        still_wrong = {verdict.sensor_id for verdict in verdicts if verdict.is_still_wrong}
        if checked.left_out.keys() <= still_wrong:
            break
        verdicts = tuple(add_faults(verdicts, checked.work.verdicts))
    else:
        return None
    return Settled(work._replace(verdicts=verdicts), solved, clocks=_clocks(verdicts))


def _error_km(*doubts: Doubt) -> float:
    """Return the error [km] per axis of all sensors' positions that explains the disagreement."""
    shared = [abs(each.shared_s) for each in doubts if np.isfinite(each.shared_s)]
    moved_km = SPEED_KM_S * max(shared, default=0.0)
    return max(MARGIN * max(each.spread_km for each in doubts), moved_km)


def _clocks(verdicts: Iterable[SensorVerdict]) -> tuple[SensorVerdict, ...]:
    """Return the verdicts on clocks that are wrong."""
    return tuple(verdict for verdict in verdicts if verdict.has_wrong_clock)


def sides_of(work: Work, solved: SolvedParts, window_s: float) -> Sides:
    """Return which sensors agree: each tracklet counts once per window of `window_s` [s]."""
    names = {sensor.number: sensor.sensor_id for sensor in work.spans}
    joined, left_out, unclear = (dict.fromkeys(names.values(), 0) for _ in range(3))
    for span in work.all_spans():
        if not solved.holds(span):
            continue
        members = solved.objects.read(span, "members", ["sensor", "first_epoch", "last_epoch"])
        first, last = (
            array(members, name) // round(window_s * SECOND_NS)
            for name in ("first_epoch", "last_epoch")
        )
        count = np.bincount(array(members, "sensor"), last - first + 1)
        for number in np.flatnonzero(count).tolist():
            joined[names[number]] += int(count[number])
        counted = {Reason.SENSOR_DISAGREES: left_out, Reason.UNDECIDED: unclear}
        for rows in solved.of_blocks(span, "rejects"):
            for reason, of_reason in counted.items():
                found = rows.filter(pc.equal(rows["reason"], reason.value))
                for name, count in zip(
                    found["sensor_id"].to_pylist(), found["count"].to_pylist(), strict=True
                ):
                    of_reason[name] += count
    disagree = {name for name, count in left_out.items() if count > joined[name]}
    return Sides(
        {name for name, count in joined.items() if count} - disagree,
        disagree,
        {name for name, count in unclear.items() if count > joined[name]} - disagree,
    )

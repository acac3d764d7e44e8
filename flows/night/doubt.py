"""Doubt: what is solved where sensors disagree, be it clear or not who is wrong.

A sensor that is wrong takes part without its fault, or is left out.

Sensors that agree with each other may be those that are wrong. So where no more sensors agree than
not, or several sets of faults explain the lines of sight as well, no sensor is left out: the
positions of all sensors get an error as large as the disagreement shows, and the night is solved
with it. Its positions have the covariances of such errors.
"""

import logging
from collections.abc import Iterable
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

MAX_ROUNDS = 3  # in which faults are found that others hid; two of seven sensors took two
WIDE_KM = 10.0  # error with which all sensors take part, to learn how far they disagree
# The spread is that about the mean of all sensors. If half of them have the same error, their mean
# is off by as much. With 1, half of the positions lay outside their 99 % ellipsoids then; with 2
# and 3, none.
MARGIN = 2.0
# Of errors larger than stated, which are nobody's in particular. Sound scenes have up to 1.4.
MIN_LOG_ODDS = 6.0


class Settled(NamedTuple):
    """A night that is solved, and what is wrong without a name; None where nothing is.

    `clocks` are those that are wrong, be they corrected or not.
    """

    work: Work
    solved: SolvedParts
    doubt: Doubt | None = None
    clocks: tuple[SensorVerdict, ...] = ()


def settle(work: Work, solved: SolvedParts, checked: Checked, settings: Settings) -> Settled:
    """Solve a night again where sensors are at fault, or in doubt.

    Parameters
    ----------
    work
        As it was before the check.
    """
    window_s = settings.association.window_s
    if not in_doubt(checked.work, solved, checked, window_s):
        judged = _judge_left_out(work, solved, checked, settings)
        if (settled := _solve_with_faults(work, solved, judged, settings)) is not None:
            return settled
    wide = solve(work, settings, added=AddedErrors(WIDE_KM))
    judged = check(work, wide, settings, correct=False)
    clocks = _clocks(judged.work.verdicts)
    is_clear = judged.left_out and not in_doubt(judged.work, wide, judged, window_s)
    if is_clear and (settled := _solve_with_faults(work, wide, judged, settings)) is not None:
        return settled
    more_km = _error_km(checked.doubt, judged.doubt)
    LOGGER.warning(
        "sensors disagree, and who is wrong is not clear: an error of %.2g km per axis is added "
        "to the positions of all %s", more_km, many(len(work.spans), "sensor"),
    )  # fmt: skip
    unnamed = tuple(one._replace(cause=SOUND) for one in judged.work.verdicts)
    solved = solve(work, settings, added=AddedErrors(more_km))
    return Settled(judged.work._replace(verdicts=unnamed), solved, judged.doubt, clocks)


def _judge_left_out(
    work: Work, solved: SolvedParts, checked: Checked, settings: Settings
) -> Checked:
    """Return the check with verdicts on sensors that are so wrong that they join no objects.

    Parameters are those of `settle`. Such sensors take part with a wide error. The check stays as
    it is if others are at fault then, or it is not clear who is.
    """
    window_s = settings.association.window_s
    named = {one.sensor_id for one in checked.work.verdicts if one.is_faulty}
    sides = _sides(work, solved, window_s)
    apart = (sides.disagree | sides.unclear) - named
    if not apart:
        return checked
    suspects = sorted(apart | set(checked.left_out))
    wide = solve(
        work, settings,
        added=AddedErrors(faults=tuple(SensorFault(s, WIDE_KM, left_km=WIDE_KM) for s in suspects)),
    )  # fmt: skip
    judged = check(work, wide, settings, correct=False)
    faulty = {one.sensor_id for one in judged.work.verdicts if one.is_faulty}
    is_clear = not in_doubt(judged.work, wide, judged, window_s)
    as_before = (
        faulty <= named.union(suspects) and judged.left_out.keys() >= checked.left_out.keys()
    )
    return judged if is_clear and as_before else checked


def _solve_with_faults(
    work: Work, solved: SolvedParts, checked: Checked, settings: Settings
) -> Settled | None:
    """Solve a night without the faults of its sensors, until there is no other; None in doubt.

    Sensors whose fault is unknown or too large are left out. A fault may hide another one, so the
    sensors are judged again without it. Parameters are those of `settle`.
    """
    left_out: dict[str, Reason] = {}
    verdicts = checked.work.verdicts
    for _ in range(MAX_ROUNDS):
        faults = tuple(fault for one in verdicts if (fault := one.fault()) is not None)
        taking_part = {fault.sensor_id for fault in faults}
        left_out |= {name: why for name, why in checked.left_out.items() if name not in taking_part}
        if not (checked.left_out or faults):
            break
        solved = solve(work, settings, left_out, AddedErrors(faults=faults))
        checked = check(work, solved, settings, correct=False)
        if in_doubt(checked.work, solved, checked, settings.association.window_s):
            return None
        still_wrong = {one.sensor_id for one in verdicts if one.is_still_wrong}
        if checked.left_out.keys() <= still_wrong:
            break
        verdicts = tuple(add_faults(verdicts, checked.work.verdicts))
    else:
        return None
    return Settled(work._replace(verdicts=verdicts), solved, clocks=_clocks(verdicts))


def _error_km(*doubts: Doubt) -> float:
    """Return the error of the positions of all sensors that the disagreement shows."""
    shared = [abs(each.shared_s) for each in doubts if np.isfinite(each.shared_s)]
    moved_km = SPEED_KM_S * max(shared, default=0.0)
    return max(MARGIN * max(each.spread_km for each in doubts), moved_km)


def _clocks(verdicts: Iterable[SensorVerdict]) -> tuple[SensorVerdict, ...]:
    """Return the verdicts on clocks that are wrong."""
    return tuple(one for one in verdicts if one.has_wrong_clock)


def in_doubt(work: Work, solved: SolvedParts, checked: Checked, window_s: float) -> bool:
    """Return whether it is not clear which sensors are wrong; `window_s` is that of association.

    A clock is wrong against the states of the same sensor: it needs no others that agree.
    """
    doubt = checked.doubt
    if doubt.undecided or np.isfinite(doubt.shared_s) or doubt.spread_log_odds > MIN_LOG_ODDS:
        return True
    agree, disagree, _ = _sides(work, solved, window_s)
    late = {one.sensor_id for one in _clocks(checked.work.verdicts)}
    faulty = {name for name, why in checked.left_out.items() if why != Reason.CLOCK_OFF}
    agree, disagree = agree - set(checked.left_out) - late, (disagree - late) | faulty
    return bool(disagree) and len(agree) < max(len(disagree) + 1, LEAST_AGREEING)


class _Sides(NamedTuple):
    """Sensors that have objects with others, those mostly left out at that, and those of the first
    whose tracklets mostly may be of an object, or not."""

    agree: set[str]
    disagree: set[str]
    unclear: set[str]


def _sides(work: Work, solved: SolvedParts, window_s: float) -> _Sides:
    """Return who agrees with whom, by tracklets and windows of association, of `window_s` [s]."""
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
    return _Sides(
        {name for name, count in joined.items() if count} - disagree,
        disagree,
        {name for name, count in unclear.items() if count > joined[name]} - disagree,
    )

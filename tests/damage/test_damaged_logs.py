"""A short round of damaged logs, odd values and bombs; `long_round.py` is the long one."""

import collections

import pytest

from damage import cases, container
from damage.cases import Case, Promise
from damage.judge import judge
from damage.long_round import fault_line, fields_and_bombs
from damage.sound_logs import NAMES, count, sound_log
from damage.workers import judged

N_LOGS = 300
LOOSE = "protobuf_loose"


@pytest.mark.long
def test_no_damage_breaks_the_reader_or_loses_a_message_without_a_reject():
    asked = [*fields_and_bombs(), *(("case", (number,)) for number in range(N_LOGS))]
    answers = list(judged(asked))
    assert [fault_line(answer) for answer in answers if answer.verdict.fault] == []
    assert len(answers) == len(asked)
    # Else the round would prove little.
    outcomes = collections.Counter(answer.verdict.outcome for answer in answers)
    assert min(outcomes["all read"], outcomes["some left out"]) > N_LOGS / 4
    promises = collections.Counter(answer.promise for answer in answers)
    assert promises["exact"] + promises["counted"] > N_LOGS / 2


@pytest.mark.parametrize("name", NAMES)
def test_a_sound_log_is_read_whole(name, tmp_path):
    verdict = judge(Case(name, sound_log(name), count(name), Promise.EXACT), tmp_path)
    assert (verdict.outcome, verdict.reasons) == ("all read", {})


@pytest.mark.parametrize("promise", [Promise.EXACT, Promise.COUNTED, Promise.SAID])
def test_a_message_that_is_lost_is_noticed(promise, tmp_path):
    """The judge must fail a reader that loses one."""
    case = Case("one more", sound_log(LOOSE), count(LOOSE) + 1, promise)
    assert judge(case, tmp_path).fault


def test_a_number_gives_the_same_log_again():
    assert [cases.case(number) for number in range(20)] == [cases.case(n) for n in range(20)]


@pytest.mark.parametrize("name", NAMES)
def test_a_log_taken_apart_is_put_together_the_same(name):
    log = sound_log(name)
    assert container.joined(*container.split(container.records_of(log))) == log


# What a round has found


def test_a_damaged_schema_hides_no_message_where_the_summary_has_it(tmp_path):
    log = sound_log(LOOSE)
    at = log.index(b"epipole.CentroidFrame")
    assert at < container.summary_start(log)
    damaged = log[:at] + b"f" + log[at + 1 :]
    verdict = judge(Case("", damaged, count(LOOSE), Promise.COUNTED), tmp_path)
    assert verdict.outcome == "all read"
    assert set(verdict.reasons) == {"damaged_record"}

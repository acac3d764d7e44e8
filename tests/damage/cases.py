"""A damaged log for each number, the same one each time, and what may be asked of its reading."""

from collections.abc import Callable
from enum import StrEnum
from random import Random
from typing import NamedTuple

from damage import bombs, byte_damage, odd_values, record_damage
from damage.container import counts_of, data_end
from damage.sound_logs import FORMS, NAMES, Key, count, keys, sound_log


class Promise(StrEnum):
    """How much is known of the messages that a damaged log had before."""

    EXACT = "exact"  # each is read or counted, once
    COUNTED = "counted"  # the summary still counts them: all are read or counted
    SAID = "said"  # checksums tell of any loss: where one is lost, something is said
    NONE = "none"  # what is lost may leave no trace, such as a record taken out of an open log


class Case(NamedTuple):
    """A damaged log."""

    what: str
    log: bytes
    n: int  # messages of the sound log
    promise: Promise
    keys: frozenset[Key] = frozenset()  # of these messages


def case(number: int) -> Case:
    """Return the damaged log of a number."""
    chance = Random(number)
    make = chance.choices((_of_bytes, _of_records, _of_values), (45, 35, 20))[0]
    return make(chance)


def case_of_field(encoding: str, kind: str, field: str) -> Case:
    """Return a log with all odd values of a field."""
    return Case(f"{encoding}: {kind}.{field}", *odd_values.log_of_field(encoding, kind, field),
                Promise.EXACT)  # fmt: skip


def case_of_bomb(name: str) -> Case:
    """Return a log that is made to be a burden."""
    return Case(name, bombs.BOMBS[name](), 0, Promise.NONE)


def _of_bytes(chance: Random) -> Case:
    name, how = chance.choice(NAMES), chance.choice(byte_damage.DAMAGES)
    log = how(chance, sound_log(name))
    options = FORMS[name].options if name in FORMS else {}
    checked = options.get("enable_crcs", True) and options.get("use_chunking", True)
    if options.get("enable_data_crcs"):
        checked = data_end(sound_log(name)).data in log  # what is damaged does not fit it
    said = checked or how in byte_damage.KEEPING
    return _known(name, how, log, Promise.SAID if said else Promise.NONE)


def _of_records(chance: Random) -> Case:
    name, how = chance.choice(NAMES), chance.choice(record_damage.DAMAGES)
    log = record_damage.damage_records(how, chance, sound_log(name))
    said = how in record_damage.KEEPING
    return _known(name, how, log, Promise.SAID if said else Promise.NONE)


def _known(name: str, how: Callable[..., object], log: bytes, otherwise: Promise) -> Case:
    before = counts_of(sound_log(name))
    counted = before is not None and counts_of(log) == before
    what = f"{name}: {how.__name__}"
    promise = Promise.COUNTED if counted else otherwise
    return Case(what, log, count(name), promise, keys(name))


def _of_values(chance: Random) -> Case:
    return Case(*odd_values.log_of_chance(chance), Promise.EXACT)

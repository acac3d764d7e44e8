"""Damage to the bytes of a log, whatever they mean. Each takes a source of chance and the log."""

from collections.abc import Callable
from random import Random

from damage.container import FOOTER_BYTES, HEAD, summary_start, with_footer

Bytes = bytes
MAX_BITS, LONGEST = 20, 3000


def flip_bits(chance: Random, log: Bytes) -> Bytes:
    """Return the log with one to twenty bits the other way."""
    out = bytearray(log)
    for _ in range(chance.choice((1, 1, 1, 2, 5, MAX_BITS))):
        out[chance.randrange(len(out))] ^= 1 << chance.randrange(8)
    return bytes(out)


def overwrite(chance: Random, log: Bytes) -> Bytes:
    """Return the log with a range of zeros, ones, or any bytes."""
    at, length = _range(chance, log)
    filling = chance.choice((bytes(length), b"\xff" * length, chance.randbytes(length)))
    return log[:at] + filling + log[at + length :]


def delete(chance: Random, log: Bytes) -> Bytes:
    """Return the log without a range."""
    at, length = _range(chance, log)
    return log[:at] + log[at + length :]


def insert(chance: Random, log: Bytes) -> Bytes:
    """Return the log with any bytes in it."""
    at, length = _range(chance, log)
    return log[:at] + chance.choice((bytes(length), chance.randbytes(length))) + log[at:]


def duplicate(chance: Random, log: Bytes) -> Bytes:
    """Return the log with a range twice: at once, or again at another place."""
    at, length = _range(chance, log)
    to = chance.choice((at + length, chance.randrange(len(log))))
    return log[:to] + log[at : at + length] + log[to:]


def swap(chance: Random, log: Bytes) -> Bytes:
    """Return the log with two ranges of equal length in each other's place."""
    at, length = _range(chance, log)
    to = chance.randrange(len(log))
    first, second = sorted((at, to))
    length = min(length, second - first, len(log) - second)
    middle = log[first + length : second]
    moved = log[second : second + length] + middle + log[first : first + length]
    return log[:first] + moved + log[second + length :]


def truncate(chance: Random, log: Bytes) -> Bytes:
    """Return the beginning of the log; sometimes zeros up to its size follow."""
    at = chance.randrange(len(log))
    return log[:at] + (bytes(len(log) - at) if chance.random() < 0.2 else b"")


def damage_summary(chance: Random, log: Bytes) -> Bytes:
    """Return the log with bits of its summary the other way; sometimes its checksum fits."""
    start = summary_start(log)
    out = bytearray(log)
    for _ in range(chance.choice((1, 2, 5))):
        out[chance.randrange(start, len(out))] ^= 1 << chance.randrange(8)
    return with_footer(bytes(out), start) if chance.random() < 0.7 else bytes(out)


def damage_footer(chance: Random, log: Bytes) -> Bytes:
    """Return the log with any bytes in its footer."""
    out = bytearray(log)
    for _ in range(chance.choice((1, 4, 8))):
        out[len(log) - 1 - chance.randrange(FOOTER_BYTES)] = chance.randrange(256)
    return bytes(out)


def damage_data_end(chance: Random, log: Bytes) -> Bytes:
    """Return the log with any bytes in the record that ends its data, or in its footer."""
    out, start = bytearray(log), summary_start(log)
    places = [*range(start - HEAD.size - 4, start), *range(len(log) - FOOTER_BYTES, len(log))]
    for _ in range(chance.choice((1, 1, 4))):
        out[chance.choice(places)] = chance.randrange(256)
    return bytes(out)


def damage_number(chance: Random, log: Bytes) -> Bytes:
    """Return the log with an odd integer of 2, 4 or 8 bytes at any place."""
    width = chance.choice((2, 4, 8))
    odd = (0, 1, 5, 1 << (8 * width - 1), (1 << 8 * width) - 1, len(log), chance.getrandbits(16))
    at = chance.randrange(len(log) - width)
    value = chance.choice(odd) % (1 << 8 * width)
    return log[:at] + value.to_bytes(width, "little") + log[at + width :]


def join_logs(chance: Random, log: Bytes) -> Bytes:
    """Return the log with itself behind it, and a damaged bit in all of that."""
    end = chance.choice((len(log), chance.randrange(len(log))))
    return flip_bits(chance, log[:end] + log) if chance.random() < 0.8 else log[:end] + log


def _range(chance: Random, log: Bytes) -> tuple[int, int]:
    at = chance.randrange(len(log))
    length = int(LONGEST ** chance.random())
    return at, min(length, len(log) - at)


# After these the log still has all its messages: each must be read, or something said.
KEEPING = (damage_summary, damage_footer, damage_data_end)
DAMAGES: tuple[Callable[[Random, Bytes], Bytes], ...] = (
    flip_bits, flip_bits, overwrite, delete, insert, duplicate, swap, truncate,
    damage_summary, damage_footer, damage_data_end, damage_number, damage_number, join_logs,
)  # fmt: skip

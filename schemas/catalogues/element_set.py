"""A published element set: the mean elements of a satellite for SGP4."""

from collections.abc import Iterable
from typing import NamedTuple


class ElementSet(NamedTuple):
    """The mean elements of one satellite at their epoch, of WGS 72."""

    name: str  # empty where the file has none
    number: int  # of the satellite catalogue
    epoch_ns: int  # UTC since 1970
    # The arguments of `sgp4init`, in its order: days since 1949 December 31 0h UTC, 1 / Earth
    # radii, rad/min^2 (half the first derivative), rad/min^3 (a sixth of the second), and angles
    # in rad; the mean motion in rad/min.
    elements: tuple[float, ...]
    cospar_id: str = ""  # such as 1998-067A; empty where the file has none

    @property
    def label(self) -> str:
        """Return its name and number, for messages."""
        return f"{self.name} ({self.number})" if self.name else str(self.number)

    def is_called(self, name: str) -> bool:
        """Return whether this is its name, in any case, or its catalogue number."""
        return name.strip().upper() in (self.name.upper(), str(self.number))


def nearest_sets(sets: Iterable[ElementSet], time_ns: int) -> list[ElementSet]:
    """Return one set for each object: that whose epoch is nearest to a time."""
    nearest: dict[int, ElementSet] = {}
    for each in sets:
        other = nearest.get(each.number)
        if other is None or abs(each.epoch_ns - time_ns) < abs(other.epoch_ns - time_ns):
            nearest[each.number] = each
    return list(nearest.values())

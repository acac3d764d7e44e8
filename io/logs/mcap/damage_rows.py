"""What is damaged in a log, as rows of bounded number."""

from dataclasses import dataclass, field
from typing import NamedTuple

from epipole.schemas.rejects import Reason

# Rows for one reason; the last one counts the others too. Of more damage of one kind nobody reads
# each row, and a file may have millions.
MAX_ALIKE = 1000


class Damage(NamedTuple):
    """Messages that were left out: where, when (0: unknown), why, how many."""

    offset: int
    time_ns: int
    reason: Reason
    n: int


@dataclass
class DamageRows:
    """The damage of one log, in the order in which it was found."""

    rows: list[Damage] = field(default_factory=list)
    _alike: dict[Reason, list[int]] = field(default_factory=dict)  # rows of each reason

    def add(self, offset: int, time_ns: int, reason: Reason, n: int = 1) -> int:
        """Add damage; return the number of its row, which may have other damage too."""
        alike = self._alike.setdefault(reason, [])
        if len(alike) == MAX_ALIKE:
            self.count(alike[-1], n)
        else:
            alike.append(len(self.rows))
            self.rows.append(Damage(offset, time_ns, reason, n))
        return alike[-1]

    def count(self, row: int, n: int) -> None:
        """Count more messages in a row."""
        self.rows[row] = self.rows[row]._replace(n=self.rows[row].n + n)

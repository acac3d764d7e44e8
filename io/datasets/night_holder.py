"""Who is at work on which nights of a dataset: what a claim says, wherever it is kept."""

import json
import os
import socket
import uuid
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from epipole.schemas.errors import DatasetError


@dataclass(frozen=True)
class Holder:
    """A run, and the nights that it has claimed."""

    nights: list[str]
    host: str
    pid: int
    since: str
    machine: str  # within which a process number means one process; empty: unknown
    token: str  # no two claims have the same

    @classmethod
    def of(cls, nights: Sequence[str]) -> Self:
        """Return this process, as from now."""
        since = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        host, token = socket.gethostname(), uuid.uuid4().hex
        return cls(sorted(nights), host, os.getpid(), since, _machine(), token)

    @classmethod
    def read(cls, text: str | bytes) -> Self:
        """Return what `text` wrote."""
        return cls(**json.loads(text))

    def text(self) -> str:
        """Return it as a line of JSON."""
        return json.dumps(asdict(self)) + "\n"

    def is_gone(self) -> bool:
        """Return whether the process has ended for certain: it was one of this machine."""
        if not self.machine or self.machine != _machine():
            return False
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return True
        except PermissionError:
            pass  # it is another user's
        return False

    def refuse(self, dataset: object, nights: Sequence[str]) -> None:
        """Raise where one of these nights is this holder's.

        Raises
        ------
        DatasetError
            Names the night, the process, its host and since when.
        """
        for night in nights:
            if night in self.nights:
                raise DatasetError(
                    f"{dataset}/night={night}: process {self.pid} on {self.host} has been at work "
                    f"on it since {self.since}; wait for it to end, or stop it"
                )


def _machine() -> str:
    """Return this boot of this machine, and the container that process numbers count in."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot}-{Path('/proc/self/ns/pid').stat().st_ino}"
    except OSError:
        return ""

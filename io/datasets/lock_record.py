"""Locks of nights: which run works on which nights of a dataset, as a line of JSON."""

import json
import os
import socket
import uuid
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from epipole.schemas.dates import is_night
from epipole.schemas.errors import DatasetError

STAGING = ".staging"  # the folder of a dataset that has locks and unfinished work


@dataclass(frozen=True)
class LockRecord:
    """A run, and the nights that it has locked."""

    nights: list[str]
    host: str
    pid: int
    since: str
    machine: str  # where process numbers are unique; empty: unknown
    token: str  # unique to the lock

    @classmethod
    def of(cls, nights: Sequence[str]) -> Self:
        """Return the record of this process, from now on."""
        since = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        host, token = socket.gethostname(), uuid.uuid4().hex
        return cls(sorted(nights), host, os.getpid(), since, _machine(), token)

    @classmethod
    def read(cls, text: str | bytes, where: object) -> Self:
        """Return the record that `text` wrote; `where` names the file in messages.

        Raises
        ------
        DatasetError
            Where it is not the record of a lock.
        """
        try:
            record = cls(**json.loads(text))
            words = (record.host, record.since, record.machine, record.token)
            if not all(isinstance(word, str) for word in words) or type(record.pid) is not int:
                raise TypeError
            if not isinstance(record.nights, list) or not all(map(is_night, record.nights)):
                raise TypeError
        except (TypeError, ValueError, RecursionError) as error:
            raise DatasetError(f"{where}: is not the lock of a run; remove it") from error
        return record

    def text(self) -> str:
        """Return the record as a line of JSON."""
        return json.dumps(asdict(self)) + "\n"

    def is_gone(self) -> bool:
        """Return whether the process has ended. On another machine it counts as running."""
        if not self.machine or self.machine != _machine():
            return False
        try:
            os.kill(self.pid, 0)
        except (ProcessLookupError, OverflowError):
            return True
        except PermissionError:
            pass  # it runs, as another user
        return False

    def refuse(self, dataset: object, nights: Sequence[str]) -> None:
        """Raise where its run has locked one of these nights.

        Raises
        ------
        DatasetError
            Names the night, the process, its host and its start.
        """
        for night in nights:
            if night in self.nights:
                raise DatasetError(
                    f"{dataset}/night={night}: process {self.pid} on {self.host} has worked on "
                    f"it since {self.since}; wait for it to end, or stop it"
                )


def _machine() -> str:
    """Return an id of this boot of this machine, and of the container of this process."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot}-{Path('/proc/self/ns/pid').stat().st_ino}"
    except OSError:
        return ""

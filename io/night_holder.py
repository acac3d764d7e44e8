"""Who is at work on which nights of a dataset: what a claim says, wherever it is kept."""

import json
import os
import socket
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Self

from epipole.schemas.errors import DatasetError


@dataclass(frozen=True)
class Holder:
    """A run, and the nights that it has claimed."""

    nights: list[str]
    host: str
    pid: int
    since: str

    @classmethod
    def of(cls, nights: Sequence[str]) -> Self:
        """Return this process, as from now."""
        since = datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        return cls(sorted(nights), socket.gethostname(), os.getpid(), since)

    @classmethod
    def read(cls, text: str | bytes) -> Self:
        """Return what `text` wrote."""
        return cls(**json.loads(text))

    def text(self) -> str:
        """Return it as a line of JSON."""
        return json.dumps(asdict(self)) + "\n"

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

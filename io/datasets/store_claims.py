"""Claims of nights in an object store: objects that a run renews.

``.staging/claim-night=YYYY-MM-DD.json`` is created only if it does not exist (on S3 by
``If-None-Match: *``). Its run renews it every minute. A claim that was not renewed for `LEASE_S`
belongs to a run that has ended, and may be taken over. If that run was a process of this machine
that has ended, this is known at once. The machine's clock must agree with the store's to about a
minute.
"""

import contextlib
import threading
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from typing import Any

from epipole.io.datasets.night_holder import Holder
from epipole.io.remote_files import storage_errors
from epipole.schemas.errors import DatasetError

STAGING = ".staging"
RENEWED_EVERY_S = 60.0
LEASE_S = 300.0


class StoreClaims:
    """The claims of one dataset, and those of them that this process holds."""

    def __init__(self, storage: Any, root: str, dataset: str) -> None:
        self._storage, self._root, self._dataset = storage, root, dataset
        self._held: dict[str, Holder] = {}

    @contextlib.contextmanager
    def claim(self, nights: Sequence[str]) -> Iterator[None]:
        """Reserve these nights for this run.

        Raises
        ------
        DatasetError
            Where a living run has claimed one of them. The message names the run.
        """
        holder, ended = Holder.of(nights), threading.Event()
        taken: list[str] = []
        renewing = threading.Thread(
            target=self._renew, args=(holder, taken, ended), name="renew claims", daemon=True
        )
        try:
            for night in holder.nights:
                self._take(night, holder)
                taken.append(night)
                self._held[night] = holder
            if taken:
                renewing.start()
            yield
        finally:
            ended.set()
            if renewing.ident is not None:
                renewing.join()
            for night in taken:
                self._held.pop(night, None)
                with contextlib.suppress(*storage_errors()):  # else the next run takes it over
                    if self._is_held(night, holder):
                        self._storage.rm_file(self._path(night))

    def missing(self, nights: Sequence[str]) -> list[str]:
        """Return the nights among these that this process has not claimed."""
        return [night for night in nights if night not in self._held]

    def verify(self, nights: Sequence[str]) -> None:
        """Raise unless this process still holds the claims of these nights.

        Raises
        ------
        DatasetError
            Where another run has taken over a claim that was not renewed in time.
        """
        for night in nights:
            if not self._is_held(night, self._held[night]):
                raise DatasetError(
                    f"{self._dataset}/night={night}: another run has taken it over, because this "
                    "run did not renew its claim in time; run again"
                )

    def alive(self) -> set[str]:
        """Return the tokens of the living runs, and remove the claims of runs that have ended."""
        tokens = set()
        for path in self._storage.glob(f"{self._root}/{STAGING}/claim-*.json"):
            holder = self._read(path)
            if holder is not None and self._is_dead(path, holder):
                with contextlib.suppress(FileNotFoundError):
                    self._storage.rm_file(path)
            elif holder is not None:
                tokens.add(holder.token)
        return tokens

    def token(self, night: str) -> str:
        """Return the token of a claim that this process holds."""
        return self._held[night].token

    def _path(self, night: str) -> str:
        return f"{self._root}/{STAGING}/claim-night={night}.json"

    def _take(self, night: str, holder: Holder) -> None:
        path = self._path(night)
        for _ in range(2):
            try:
                self._storage.pipe_file(path, holder.text().encode(), mode="create")
                return
            except FileExistsError:
                other = self._read(path)
            if other is not None:
                if not self._is_dead(path, other):
                    other.refuse(self._dataset, [night])
                with contextlib.suppress(FileNotFoundError):
                    self._storage.rm_file(path)
        raise DatasetError(f"{self._dataset}/night={night}: another run has just claimed it")

    def _read(self, path: str) -> Holder | None:
        try:
            return Holder.read(self._storage.cat_file(path), path)
        except FileNotFoundError:
            return None

    def _is_held(self, night: str, holder: Holder) -> bool:
        current = self._read(self._path(night))
        return current is not None and current.token == holder.token

    def _is_dead(self, path: str, holder: Holder) -> bool:
        if holder.is_gone():
            return True
        self._storage.invalidate_cache()
        try:
            modified: datetime = self._storage.modified(path)
        except FileNotFoundError:
            return True
        if modified.tzinfo is None:
            modified = modified.replace(tzinfo=UTC)
        return (datetime.now(UTC) - modified).total_seconds() > LEASE_S

    def _renew(self, holder: Holder, nights: list[str], ended: threading.Event) -> None:
        while not ended.wait(RENEWED_EVERY_S):
            for night in nights:
                with contextlib.suppress(*storage_errors()):  # tried again before the lease ends
                    if self._is_held(night, holder):
                        self._storage.pipe_file(self._path(night), holder.text().encode())

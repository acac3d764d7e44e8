"""Nights in an object store, which has no rename: staged, committed by one object, copied.

1. Every file of the nights is written to ``.staging/run-<token>/``.
2. ``.staging/commit-<token>.json`` is written by one PUT. This publishes all nights of the run:
   from now on `read` takes the staged files.
3. The store copies the files to ``night=YYYY-MM-DD/<table>/``; each copy is atomic, and `sources`
   comes last. Other files of the old night are removed.
4. The commit is removed, then the staged files.

A run that is killed before step 2 has published nothing. A run that is killed later has published
everything, and the next run on the night finishes step 3. A reader that lists the objects by a
glob pattern always gets whole tables. During step 3, a fraction of a second, some tables are of
the old night and some of the new one. A new night is complete when it has `sources`.
"""

import contextlib
import json
import re
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from epipole.io.datasets.lock_record import Holder
from epipole.io.paths import file_system, line_of, storage_errors
from epipole.schemas.dates import is_night
from epipole.schemas.errors import DatasetError

# -- Claims of nights in an object store: objects that a run renews.
#
# ``.staging/claim-night=YYYY-MM-DD.json`` is created only if it does not exist (on S3 by ``If-
# None-Match: *``). Its run renews it every minute. A claim that was not renewed for `LEASE_S`
# belongs to a run that has ended, and may be taken over. If that run was a process of this
# machine that has ended, this is known at once. The machine's clock must agree with the store's
# to about a minute.

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


# -- Nights in an object store, which has no rename: staged, committed by one object, copied.
#
# 1. Every file of the nights is written to ``.staging/run-<token>/``. 2.
# ``.staging/commit-<token>.json`` is written by one PUT. This publishes all nights of the run:
# from now on `read` takes the staged files. 3. The store copies the files to ``night=YYYY-MM-
# DD/<table>/``; each copy is atomic, and `sources` comes last. Other files of the old night are
# removed. 4. The commit is removed, then the staged files.
#
# A run that is killed before step 2 has published nothing. A run that is killed later has
# published everything, and the next run on the night finishes step 3. A reader that lists the
# objects by a glob pattern always gets whole tables. During step 3, a fraction of a second, some
# tables are of the old night and some of the new one. A new night is complete when it has
# `sources`.

REQUESTS = 8  # at the same time
LAST = "sources"  # the table that completes a night

# What a commit may name: the folder of a run, and a file of a table.
_RUN = re.compile(r"run-[0-9a-f]{32}")
_FILE = re.compile(r"[a-z_]+/[\w-]+\.parquet", re.ASCII)


@dataclass(frozen=True)
class Commit:
    """Nights that are published, but whose files are not all in place yet."""

    path: str
    staged: str  # the folder of the run, which holds night=.../<table>/*.parquet
    files: dict[str, list[str]]  # by night, <table>/<part>.parquet


class StoreNights:
    """The nights of one dataset in an object store."""

    def __init__(self, storage: Any, root: str, dataset: str) -> None:
        self._storage, self._root, self._dataset = storage, root, dataset
        self.claims = StoreClaims(storage, root, dataset)

    def names(self) -> list[str]:
        """Return the names at the top of the dataset; see `require_bucket`."""
        names = [entry.rstrip("/").rpartition("/")[2] for entry in self._ls(self._root)]
        if not names:
            self.require_bucket()
        return names

    def require_bucket(self) -> None:
        """Raise where the bucket is missing; a missing folder in it is an empty dataset.

        Raises
        ------
        DatasetError
            Names the bucket.
        """
        bucket = self._root.partition("/")[0]
        try:
            is_there = not bucket or self._storage.exists(bucket)
        except PermissionError:  # it is there; only a folder in it may be listed
            return
        if not is_there:
            raise DatasetError(
                f"{self._dataset}: there is no bucket {bucket}; create it, or check the name"
            )

    def nights(self) -> list[str]:
        """Return the nights that are published, in order."""
        in_place = {n.removeprefix("night=") for n in self.names() if n.startswith("night=")}
        in_place = set(filter(is_night, in_place))
        return sorted(in_place.union(*(commit.files for commit in self._commits())))

    def read(self, night: str, table: str) -> list[bytes]:
        """Return the files of a table of a night, in order; none where the night is missing."""
        for _ in range(3):
            with contextlib.suppress(FileNotFoundError):  # put in place or replaced meanwhile
                paths = self._paths(night, table)
                return [bytes(self._storage.cat_file(path)) for path in paths]
        self.require_bucket()
        raise DatasetError(f"{self._dataset}/night={night}: is being replaced; try again")

    def tables(self, night: str) -> set[str]:
        """Return the names of the tables that a night has files of."""
        for commit in self._commits():
            if night in commit.files:
                return {name.partition("/")[0] for name in commit.files[night]}
        paths = self._storage.glob(f"{self._root}/night={night}/*/*.parquet")
        return {path.rsplit("/", 2)[1] for path in paths}

    def opened(self, night: str, table: str) -> list[Any]:
        """Return the files of a table of a night, open: only what is asked for is fetched."""
        return [self._storage.open(path, "rb") for path in self._paths(night, table)]

    def write(self, name: str, data: bytes) -> None:
        """Write one object at the top of the dataset, or in a folder there."""
        self._storage.pipe_file(f"{self._root}/{name}", data)

    def publish(self, staged: Mapping[str, Path]) -> None:
        """Publish these nights, which this process has claimed: all or none.

        Raises
        ------
        DatasetError
            Where a claim was lost meanwhile.
        """
        nights = list(staged)
        token = self.claims.token(nights[0])
        run = f"{self._root}/{STAGING}/run-{token}"
        files = {
            night: sorted(str(p.relative_to(folder)) for p in folder.glob("*/*.parquet"))
            for night, folder in staged.items()
        }
        commit = Commit(f"{self._root}/{STAGING}/commit-{token}.json", run, files)
        moves = [
            (str(staged[night] / name), f"{run}/night={night}/{name}")
            for night, names in files.items()
            for name in names
        ]
        try:
            self._each(self._storage.put_file, moves)
            self.claims.verify(nights)
            text = json.dumps({"staged": f"run-{token}", "files": files})
            self._storage.pipe_file(commit.path, text.encode())
        except BaseException:
            with contextlib.suppress(Exception):  # a later run clears what is left
                self._storage.rm(run, recursive=True)
            raise
        try:
            self._finish(commit)
        except storage_errors() as error:
            raise DatasetError(
                f"{self._dataset}: {', '.join(nights)} published, but not all files are in place "
                f"({line_of(error)}); run again to finish this"
            ) from error

    def recover(self) -> None:
        """Finish the commits of killed runs, except on nights that another run has claimed.

        The caller has claimed its own nights, so no living run has commits of them.
        """
        for commit in self._commits():
            others = self.claims.missing(list(commit.files))
            with contextlib.suppress(DatasetError), self.claims.claim(others):
                self._finish(commit)  # else the run that claimed them will
        # A run claims, then stages, then commits. So a staged folder that is listed first, and then
        # has neither a claim nor a commit, belongs to a run that has ended.
        runs = [entry.rstrip("/") for entry in self._ls(f"{self._root}/{STAGING}")]
        used = {f"run-{token}" for token in self.claims.alive()}
        used |= {commit.staged.rpartition("/")[2] for commit in self._commits()}
        for run in runs:
            name = run.rpartition("/")[2]
            if name.startswith("run-") and name not in used:
                self._storage.rm(run, recursive=True)

    def _finish(self, commit: Commit) -> None:
        """Copy the committed files into place, and remove the commit."""
        for night, names in commit.files.items():
            folder = f"{self._root}/night={night}"
            moves = [(f"{commit.staged}/night={night}/{n}", f"{folder}/{n}") for n in names]
            last = [move for move in moves if move[1].startswith(f"{folder}/{LAST}/")]
            self._each(self._storage.cp_file, [move for move in moves if move not in last])
            self._each(self._storage.cp_file, last)
            new = {target for _, target in moves}
            old = [path for path in self._storage.glob(f"{folder}/*/*.parquet") if path not in new]
            self._each(self._storage.rm_file, [(path,) for path in old])
        self._storage.rm_file(commit.path)
        self._storage.rm(commit.staged, recursive=True)

    def _paths(self, night: str, table: str) -> list[str]:
        self._storage.invalidate_cache()
        for commit in self._commits():
            if night in commit.files:
                names = [name for name in commit.files[night] if name.startswith(f"{table}/")]
                return [f"{commit.staged}/night={night}/{name}" for name in names]
        paths: list[str] = sorted(
            self._storage.glob(f"{self._root}/night={night}/{table}/*.parquet")
        )
        return paths

    def _commits(self) -> list[Commit]:
        self._storage.invalidate_cache()
        staging = f"{self._root}/{STAGING}"
        commits = []
        for path in sorted(self._storage.glob(f"{staging}/commit-*.json")):
            with contextlib.suppress(FileNotFoundError):  # finished meanwhile
                commits.append(_parsed(path, staging, self._storage.cat_file(path)))
        return commits

    def _ls(self, folder: str) -> Iterator[str]:
        self._storage.invalidate_cache()
        try:
            yield from self._storage.ls(folder, detail=False)
        except FileNotFoundError:
            return

    def _each(self, work: Any, moves: Sequence[tuple[str, ...]]) -> None:
        with ThreadPoolExecutor(REQUESTS) as pool:
            for done in [pool.submit(work, *move) for move in moves]:
                done.result()


def _parsed(path: str, staging: str, text: bytes) -> Commit:
    """Return a commit. Whoever may write to the store may have written it.

    Raises
    ------
    DatasetError
        Where it is none of a run: it may name nothing outside the folder of a run and of nights.
    """
    try:
        commit = json.loads(text)
        staged, files = commit["staged"], commit["files"]
        is_one = _RUN.fullmatch(staged) and all(
            is_night(night) and isinstance(names, list) and all(map(_FILE.fullmatch, names))
            for night, names in files.items()
        )
        if not is_one:
            raise ValueError(staged)
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: is not a commit of a run; remove it") from error
    return Commit(path, f"{staging}/{staged}", files)


def store_nights(dataset: str) -> StoreNights:
    """Return the nights behind a URL; the same object each time, as it holds the claims."""
    return _store_nights(dataset.rstrip("/"))


@cache
def _store_nights(dataset: str) -> StoreNights:
    storage, root = file_system(dataset)
    return StoreNights(storage, root.rstrip("/"), dataset)

"""Nights in an object store, which has no rename: staged, committed by one object, copied.

1. Every file of the nights is written to ``.staging/run-<token>/``.
2. ``.staging/commit-<token>.json`` is written by one PUT. This publishes all nights of the run:
   from now on readers take the staged files.
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
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import pyarrow as pa

from epipole.io.caches.private_folders import temporary_folder
from epipole.io.datasets.local import REPORTS, RUNS
from epipole.io.datasets.lock_record import STAGING, LockRecord
from epipole.io.paths import file_system, line_of, storage_errors
from epipole.schemas.dates import is_night
from epipole.schemas.errors import DatasetError

# Locks of nights: objects that a run renews.
#
# ``.staging/claim-night=YYYY-MM-DD.json`` is created only if it does not exist (on S3 by
# ``If-None-Match: *``). Its run renews it every minute. A lock that was not renewed for `LEASE_S`
# belongs to a run that has ended, and may be taken over. If that run was a process of this machine,
# its end is known at once. The clocks of machine and store must agree to about a minute.

RENEWED_EVERY_S = 60.0
LEASE_S = 300.0


class StoreLocks:
    """The locks of one dataset, and those of them that this process has."""

    def __init__(self, storage: Any, root: str, dataset: str) -> None:
        self._storage, self._root, self._dataset = storage, root, dataset
        self._locked: dict[str, LockRecord] = {}

    @contextlib.contextmanager
    def lock(self, nights: Sequence[str]) -> Iterator[None]:
        """Lock these nights for this run.

        Raises
        ------
        DatasetError
            Where a living run has locked one of them. The message names the run.
        """
        record, ended = LockRecord.of(nights), threading.Event()
        taken: list[str] = []
        renewing = threading.Thread(
            target=self._renew, args=(record, taken, ended), name="renew locks", daemon=True
        )
        try:
            for night in record.nights:
                self._take(night, record)
                taken.append(night)
                self._locked[night] = record
            if taken:
                renewing.start()
            yield
        finally:
            ended.set()
            if renewing.ident is not None:
                renewing.join()
            for night in taken:
                self._locked.pop(night, None)
                with contextlib.suppress(*storage_errors()):  # else the next run takes it over
                    if self._has_lock(night, record):
                        self._storage.rm_file(self._path(night))

    def missing(self, nights: Sequence[str]) -> list[str]:
        """Return the nights among these that this process has not locked."""
        return [night for night in nights if night not in self._locked]

    def verify(self, nights: Sequence[str]) -> None:
        """Raise unless this process still has the locks of these nights.

        Raises
        ------
        DatasetError
            Where another run has taken over a lock that was not renewed in time.
        """
        for night in nights:
            if not self._has_lock(night, self._locked[night]):
                raise DatasetError(
                    f"{self._dataset}/night={night}: another run has taken it over, because this "
                    "run did not renew its lock in time; run again"
                )

    def alive(self) -> set[str]:
        """Return the tokens of the living runs, and remove the locks of runs that have ended."""
        tokens = set()
        for path, record in self._records():
            if self._is_dead(path, record):
                with contextlib.suppress(FileNotFoundError):
                    self._storage.rm_file(path)
            else:
                tokens.add(record.token)
        return tokens

    def nights(self) -> set[str]:
        """Return the nights that living runs have locked."""
        living = [r for path, r in self._records() if not self._is_dead(path, r)]
        return {night for record in living for night in record.nights}

    def _records(self) -> Iterator[tuple[str, LockRecord]]:
        for path in self._storage.glob(f"{self._root}/{STAGING}/claim-*.json"):
            if (record := self._read(path)) is not None:
                yield path, record

    def token(self, night: str) -> str:
        """Return the token of a lock that this process has."""
        return self._locked[night].token

    def _path(self, night: str) -> str:
        return f"{self._root}/{STAGING}/claim-night={night}.json"

    def _take(self, night: str, record: LockRecord) -> None:
        path = self._path(night)
        for _ in range(2):
            try:
                self._storage.pipe_file(path, record.text().encode(), mode="create")
                return
            except FileExistsError:
                other = self._read(path)
            if other is not None:
                if not self._is_dead(path, other):
                    other.refuse(self._dataset, [night])
                with contextlib.suppress(FileNotFoundError):
                    self._storage.rm_file(path)
        raise DatasetError(f"{self._dataset}/night={night}: another run has just locked it")

    def _read(self, path: str) -> LockRecord | None:
        try:
            return LockRecord.read(self._storage.cat_file(path), path)
        except FileNotFoundError:
            return None

    def _has_lock(self, night: str, record: LockRecord) -> bool:
        current = self._read(self._path(night))
        return current is not None and current.token == record.token

    def _is_dead(self, path: str, record: LockRecord) -> bool:
        if record.is_gone():
            return True
        self._storage.invalidate_cache()
        try:
            modified: datetime = self._storage.modified(path)
        except FileNotFoundError:
            return True
        if modified.tzinfo is None:
            modified = modified.replace(tzinfo=UTC)
        return (datetime.now(UTC) - modified).total_seconds() > LEASE_S

    def _renew(self, record: LockRecord, nights: list[str], ended: threading.Event) -> None:
        while not ended.wait(RENEWED_EVERY_S):
            for night in nights:
                with contextlib.suppress(*storage_errors()):  # tried again before the lease ends
                    if self._has_lock(night, record):
                        self._storage.pipe_file(self._path(night), record.text().encode())


# Nights of a dataset.

REQUESTS = 8  # at the same time
LAST = "sources"  # the table that completes a night

# What a commit may name: the folder of a run, and a file of a table.
_RUN = re.compile(r"run-[0-9a-f]{32}")
_FILE = re.compile(r"[a-z_]+/[\w-]+\.parquet", re.ASCII)


@dataclass(frozen=True)
class Commit:
    """Nights that are published, but whose files are not all in place yet."""

    path: str
    staged: str  # the folder of the run: night=.../<table>/*.parquet in it
    files: dict[str, list[str]]  # by night, <table>/<part>.parquet


class StoreNights:
    """The nights of one dataset in an object store; see `NightStorage` for the methods."""

    folder = None

    def __init__(self, storage: Any, root: str, dataset: str) -> None:
        self._storage, self._root, self._dataset = storage, root, dataset
        self.locks = StoreLocks(storage, root, dataset)

    def errors(self) -> tuple[type[Exception], ...]:
        """Return the errors of the store's client."""
        return storage_errors()

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

    def exists(self) -> bool:
        """Return whether the dataset has any object: a store has no empty folders."""
        return bool(self.names())

    def nights(self) -> list[str]:
        """Return the published nights, in order."""
        in_place = {n.removeprefix("night=") for n in self.names() if n.startswith("night=")}
        in_place = set(filter(is_night, in_place))
        return sorted(in_place.union(*(commit.files for commit in self._commits())))

    def files(self, night: str, table: str) -> list[pa.BufferReader]:
        """Return the files of a table of a night, in order, as they were at one time."""
        for _ in range(3):
            with contextlib.suppress(FileNotFoundError):  # put in place or replaced meanwhile
                paths = self._paths(night, table)
                return [pa.BufferReader(bytes(self._storage.cat_file(path))) for path in paths]
        self.require_bucket()
        raise DatasetError(f"{self._dataset}/night={night}: is being replaced; try again")

    def tables(self, night: str) -> set[str]:
        """Return the names of the tables that a night has files of."""
        for commit in self._commits():
            if night in commit.files:
                return {name.partition("/")[0] for name in commit.files[night]}
        paths = self._storage.glob(f"{self._root}/night={night}/*/*.parquet")
        return {path.rsplit("/", 2)[1] for path in paths}

    def open_files(self, night: str, table: str) -> list[Any]:
        """Return the files of a table of a night, open: only what is read is fetched."""
        return [self._storage.open(path, "rb") for path in self._paths(night, table)]

    def location(self, night: str) -> str:
        """Return the URL of a night."""
        return f"{self._dataset}/night={night}"

    def write_beside(self, folder: str, name: str, data: bytes) -> None:
        """Write one object."""
        self._storage.pipe_file(f"{self._root}/{folder}/{name}", data)

    def remove_beside(self, folder: str, name: str) -> None:
        """Remove such an object, if it exists."""
        with contextlib.suppress(FileNotFoundError):
            self._storage.rm_file(f"{self._root}/{folder}/{name}")

    def files_beside(
        self, folder: str, nights: Collection[str] | None = None
    ) -> list[pa.BufferReader]:
        """Return the Parquet files in a folder beside the nights, in order; of all, or of some."""
        return [
            pa.BufferReader(bytes(self._storage.cat_file(path)))
            for path in sorted(self._storage.glob(f"{self._root}/{folder}/*.parquet"))
            if nights is None or PurePosixPath(path).stem in nights
        ]

    def sizes(self) -> dict[str, int]:
        """Return the bytes of each night, and of each file beside the nights."""
        found: dict[str, int] = {}
        self._storage.invalidate_cache()
        for path, entry in self._storage.find(self._root, detail=True).items():
            first, _, rest = path.removeprefix(f"{self._root}/").partition("/")
            if is_night(first.removeprefix("night=")) and first.startswith("night="):
                found[first] = found.get(first, 0) + (entry["size"] or 0)
            elif first in (REPORTS, RUNS) and is_night(rest.partition(".")[0]):
                found[f"{first}/{rest}"] = entry["size"] or 0
        return dict(sorted(found.items()))

    def remove(self, name: str, run: Path) -> None:
        """Remove a night or a file; of a night `sources` first: without it no night is complete."""
        where = f"{self._root}/{name}"
        if name.startswith("night="):
            with contextlib.suppress(FileNotFoundError):
                self._storage.rm(f"{where}/sources", recursive=True)
        self._storage.rm(where, recursive=name.startswith("night="))

    @contextlib.contextmanager
    def lock_nights(self, nights: Sequence[str]) -> Iterator[Path]:
        """Lock these nights, and yield a temporary folder of this machine."""
        with self.locks.lock(nights), temporary_folder("night") as work:
            yield work

    def locked_nights(self) -> set[str]:
        """Return the nights that living runs have locked."""
        return self.locks.nights()

    def publish(self, staged: Mapping[str, Path], check: Callable[[], None]) -> None:
        """Lock the nights that are not locked yet, and put all in place: all or none.

        Raises
        ------
        DatasetError
            Where a lock was lost meanwhile.
        """
        with self.locks.lock(self.locks.missing(list(staged))):
            self.recover()
            check()
            self._commit(staged)

    def _commit(self, staged: Mapping[str, Path]) -> None:
        """Upload the files, publish them by one object, and copy them into place."""
        nights = list(staged)
        token = self.locks.token(nights[0])
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
            self.locks.verify(nights)
        except BaseException:
            with contextlib.suppress(Exception):  # a later run clears what is left
                self._storage.rm(run, recursive=True)
            raise
        self._write_commit(commit)
        try:
            self._finish(commit)
        except storage_errors() as error:
            raise DatasetError(
                f"{self._dataset}: {', '.join(nights)} published, but not all files are in place "
                f"({line_of(error)}); run again to finish this"
            ) from error

    def _write_commit(self, commit: Commit) -> None:
        """Write the object that publishes the nights, or nothing.

        A store may have written it though its answer is an error, or never came. Then it is
        removed. The staged files stay: if it cannot be removed either, the next run finishes it,
        else it clears them.
        """
        staged = commit.staged.rpartition("/")[2]
        text = json.dumps({"staged": staged, "files": commit.files})
        try:
            self._storage.pipe_file(commit.path, text.encode())
        except BaseException:
            with contextlib.suppress(Exception):  # most often it is not there
                self._storage.rm_file(commit.path)
            raise

    def recover(self) -> None:
        """Finish the commits of killed runs, except on nights that another run has locked.

        The caller has locked its nights, so no living run has commits of them.
        """
        for commit in self._commits():
            others = self.locks.missing(list(commit.files))
            with contextlib.suppress(DatasetError), self.locks.lock(others):
                self._storage.invalidate_cache()
                if self._storage.exists(commit.path):  # else another run has just finished it
                    self._finish(commit)
                # Where they are locked, the run that locked them will finish it.
        # A run locks, then stages, then commits. So a staged folder that is listed first, and then
        # has neither a lock nor a commit, belongs to a run that has ended.
        runs = [entry.rstrip("/") for entry in self._ls(f"{self._root}/{STAGING}")]
        used = {f"run-{token}" for token in self.locks.alive()}
        used |= {commit.staged.rpartition("/")[2] for commit in self._commits()}
        for run in runs:
            name = run.rpartition("/")[2]
            if name.startswith("run-") and name not in used:
                with contextlib.suppress(FileNotFoundError):  # another run has just removed it
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
        Where it names something outside the folder of a run and the folders of nights.
    """
    try:
        commit = json.loads(text)
        staged, files = commit["staged"], commit["files"]
        is_valid = _RUN.fullmatch(staged) and all(
            is_night(night) and isinstance(names, list) and all(map(_FILE.fullmatch, names))
            for night, names in files.items()
        )
        if not is_valid:
            raise ValueError(staged)
    except (AttributeError, KeyError, TypeError, ValueError, RecursionError) as error:
        raise DatasetError(f"{path}: is not a commit of a run; remove it") from error
    return Commit(path, f"{staging}/{staged}", files)


def store_nights(dataset: str) -> StoreNights:
    """Return the nights behind a URL; the same object each time, as it has the locks."""
    return _store_nights(dataset.rstrip("/"))


@cache
def _store_nights(dataset: str) -> StoreNights:
    storage, root = file_system(dataset)
    return StoreNights(storage, root.rstrip("/"), dataset)

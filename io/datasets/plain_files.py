"""Files and folders that others may have written: read and entered without following links.

Whoever may write to a dataset could put a link where a run keeps its files. What is behind it
would be read, moved or overwritten with the rights of the run. A handle stays with what was
opened, whatever is put under its name later.
"""

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path

from epipole.schemas.errors import DatasetError

# Limit of a lock or a commit: ten years of nights take less than 1 MB.
MAX_BYTES = 4 << 20

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC
_FILE = os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC  # of a pipe, opening would wait for ever


@contextlib.contextmanager
def entered(folder: Path, *below: str) -> Iterator[Path]:
    """Yield a path to a folder, by a handle; none of the names in `below` may be a link.

    Raises
    ------
    DatasetError
        Where one of them is a link.
    OSError
        Where it is missing, or no folder.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        for name in below:
            folder = folder / name
            refuse_link(folder)
            inner = os.open(name, _FOLDER, dir_fd=handle)
            os.close(handle)
            handle = inner
        yield Path(f"/proc/self/fd/{handle}")
    finally:
        os.close(handle)


def opened(file: Path, flags: int = os.O_RDONLY) -> int:
    """Return a handle of a regular file: links, pipes and devices are refused.

    Raises
    ------
    DatasetError
        Where it is one of these.
    OSError
        Where it cannot be opened.
    """
    refuse_link(file)
    handle = os.open(file, flags | _FILE, 0o666)
    if stat.S_ISREG(os.fstat(handle).st_mode):
        return handle
    os.close(handle)
    raise DatasetError(f"{file}: is not a regular file; remove it")


def read_small(file: Path) -> bytes:
    """Return the content of a lock or a commit, which is small; errors are those of `opened`."""
    with open(opened(file), "rb") as opened_file:
        content = opened_file.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise DatasetError(f"{file}: is larger than {MAX_BYTES:,} bytes; remove it")
    return content


def refuse_link(path: Path) -> None:
    """Raise where a path is a symbolic link.

    Raises
    ------
    DatasetError
        Names the link.
    """
    if path.is_symlink():
        raise DatasetError(f"{path}: is a symbolic link; remove it")

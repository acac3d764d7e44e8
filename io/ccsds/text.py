"""What all messages have: times, names, a header, one place to write them."""

import datetime
import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from epipole.schemas.errors import DatasetError

ORIGINATOR = "EPIPOLE"
_UNSAFE = re.compile(r"[^A-Za-z0-9._+-]")


def times(time_ns: npt.NDArray[np.int64]) -> list[str]:
    """Return UTC times to the microsecond: more digits break readers."""
    rounded = ((time_ns + 500) // 1000).astype("datetime64[us]")
    return [str(t) for t in np.datetime_as_string(rounded, unit="us")]


def now() -> str:
    """Return the time of creation, UTC."""
    return f"{datetime.datetime.now(datetime.UTC):%Y-%m-%dT%H:%M:%S}"


def safe_name(text: str) -> str:
    """Return a name for a message or a file: letters, digits and ``._+-``, the rest as ``_``."""
    return _UNSAFE.sub("_", text) or "_"


def write_message(path: Path, text: str) -> None:
    """Write a message.

    Raises
    ------
    DatasetError
        Where the file cannot be written.
    """
    try:
        path.write_text(text, encoding="ascii")
    except OSError as error:
        raise DatasetError(f"{path}: cannot be written ({error.strerror})") from error

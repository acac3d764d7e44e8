"""The report of a night of a dataset, as one HTML file."""

import os
import tempfile
from pathlib import Path

from epipole.flows.night.reports import night_facts
from epipole.io.datasets.dataset import nights_in
from epipole.io.paths import fault_of_name
from epipole.schemas.errors import DatasetError, ReportError


def report(dataset: str, night: str, out: Path) -> int:
    """Write the report of a night, and return its size in bytes.

    Raises
    ------
    DatasetError
        Where the night does not exist or cannot be read.
    ReportError
        Where matplotlib is missing, or the file cannot be written.
    """
    if (fault := fault_of_name(str(out) if out != Path() else "")) is not None:
        raise ReportError(f"{out}: {fault}")
    if out.is_dir():
        raise ReportError(f"{out}: is a folder; give the name of a file, such as {out}/night.html")
    nights = nights_in(dataset)
    if night not in nights:
        raise DatasetError(f"{dataset}: has no night {night}")
    # Without matplotlib this module cannot be imported: it raises `ReportError`.
    from epipole.tasks.report.page import night_page

    return _write(out, night_page(night_facts(dataset, night, nights)).encode())


def _write(out: Path, data: bytes) -> int:
    """Write a file, whole or not at all."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".report-", dir=out.parent) as made:
            path = Path(made) / "report.html"
            path.write_bytes(data)
            os.replace(path, out)
    except OSError as error:
        raise ReportError(f"{out}: cannot be written ({error.strerror})") from error
    return len(data)

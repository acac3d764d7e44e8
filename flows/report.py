"""The report of a night of a dataset, or the calendar of its nights, as one HTML file."""

import os
import tempfile
from pathlib import Path
from urllib.parse import quote

from epipole.flows.night.reports import night_facts
from epipole.flows.night.run_records import read_records
from epipole.io.datasets.dataset import night_row, nights_in, report_location
from epipole.io.paths import fault_of_name, file_system, storage_errors
from epipole.schemas.errors import DatasetError, ReportError

HEAD = 4096  # bytes at the beginning of a page: its verdict is in them


def report(dataset: str, night: str | None, out: Path) -> int:
    """Write the report of a night, or the calendar (None); return its size in bytes.

    Raises
    ------
    DatasetError
        Where the night, or any night, does not exist or cannot be read.
    ReportError
        Where matplotlib is missing, or the file cannot be written.
    """
    if (fault := fault_of_name(str(out) if out != Path() else "")) is not None:
        raise ReportError(f"{out}: {fault}")
    if out.is_dir():
        raise ReportError(f"{out}: is a folder; give the name of a file, such as {out}/night.html")
    nights = nights_in(dataset)
    if night is None:
        return _write(out, _calendar(dataset, nights, out).encode())
    if night not in nights:
        raise DatasetError(f"{dataset}: has no night {night}")
    # Without matplotlib this module cannot be imported: it raises `ReportError`.
    from epipole.tasks.report.page import night_page

    return _write(out, night_page(night_facts(dataset, night, nights)).encode())


def _calendar(dataset: str, nights: list[str], out: Path) -> str:
    from epipole.tasks.report.calendar import CalendarNight, calendar_page
    from epipole.tasks.report.html import VERDICT

    if not nights:
        raise DatasetError(f"{dataset}: has no night")
    found, records = [], read_records(dataset, nights)
    for night in nights:
        try:
            row = night_row(dataset, night)
        except DatasetError:
            row = None
        page = report_location(dataset, night)
        verdict = VERDICT.search(_head_of(page))
        address = _address(page, out) if verdict else ""
        looks = records[night]["needs_look"] if night in records else []
        found.append(CalendarNight(night, row, looks, verdict[1] if verdict else "", address))
    return calendar_page(dataset, found)


def _head_of(page: str) -> str:
    """Return the beginning of a page; '' where it is missing."""
    try:
        storage, path = file_system(page)
        with storage.open(path, "rb") as file:
            return str(file.read(HEAD).decode("utf-8", "replace"))
    except storage_errors():
        return ""


def _address(page: str, out: Path) -> str:
    """Return the link from `out` to a page; '' if a browser cannot open it, such as s3://."""
    if "://" in page:
        return page if page.startswith(("http://", "https://")) else ""
    relative = os.path.relpath(page, out.parent)
    return quote(Path(relative).as_posix())


def _write(out: Path, data: bytes) -> int:
    """Write a file, whole or not at all; return its size in bytes."""
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".report-", dir=out.parent) as made:
            path = Path(made) / "report.html"
            path.write_bytes(data)
            os.replace(path, out)
    except OSError as error:
        raise ReportError(f"{out}: cannot be written ({error.strerror})") from error
    return len(data)

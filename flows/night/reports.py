"""The reports of nights: made from what is published, and written beside the nights."""

import contextlib
import dataclasses
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from epipole.flows.night.run_records import new_broken_logs
from epipole.flows.night.summary import Summary
from epipole.io.datasets.dataset import night_reader, nights_in, remove_beside, write_beside
from epipole.io.datasets.local import REPORTS
from epipole.io.datasets.night_tables import NightReader
from epipole.io.paths import line_of
from epipole.schemas.errors import ReportError
from epipole.tasks.report.night_facts import (
    NightFacts,
    ReportExtract,
    needs_look,
    read_night_facts,
)
from epipole.tasks.report.objects import MAX_NIGHTS

LOGGER = logging.getLogger(__name__)


def with_reports(summary: Summary, staged: Mapping[str, Path], write: bool) -> Summary:
    """Write the reports of published nights; return the summary with what needs a look.

    Reports of the nights as they were before are removed, also where none is written.

    The nights are published: whatever happens here, the run has succeeded. So an error is a line,
    and the other nights have their reports.

    Parameters
    ----------
    staged
        The folders in which the nights were made. Where they still exist, the dataset lies in an
        object store, and nothing has to be fetched from it.
    write
        Whether reports are written; the summary then has their extracts.
    """
    extracts: list[ReportExtract] = []
    looks: dict[str, list[str]] = {}
    write = write and _can_draw()
    try:
        nights = nights_in(summary.dataset)
    except Exception as error:  # of the store
        LOGGER.warning("no report could be made: %s", line_of(error))
        return summary
    for night in summary.nights:
        with _as_warning(night):
            # It shows the night as it was before: until the new one is written there is none.
            remove_beside(summary.dataset, REPORTS, f"{night}.html")
        with _as_warning(night):
            folder = staged[night] if staged[night].is_dir() else None
            facts = night_facts(summary.dataset, night, nights, folder)
            broken = new_broken_logs(summary.dataset, night)
            looks[night] = [*broken, *(look.sentence for look in needs_look(facts))]
            if write:
                text, extract = _page_and_extract(facts)
                write_beside(summary.dataset, REPORTS, f"{night}.html", text.encode())
                extracts.append(extract)
    return dataclasses.replace(summary, extracts=tuple(extracts), looks=looks)


@contextlib.contextmanager
def _as_warning(night: str) -> Iterator[None]:
    """Turn any error of a report, of drawing or of the store, into a line: the night is done."""
    try:
        yield
    except Exception as error:
        LOGGER.warning("the report of %s could not be made: %s", night, line_of(error))


def _can_draw() -> bool:
    """Return whether reports can be drawn; if not, a line says why.

    The looks of the nights do not depend on it.
    """
    try:
        _drawing()
    except ReportError as error:
        LOGGER.info("no report is written: %s", error)
        return False
    except Exception as error:  # of a library that does not fit the others
        LOGGER.warning("no report could be drawn: %s", line_of(error))
        return False
    return True


def load_drawing() -> None:
    """Import what draws reports, which takes a while."""
    with contextlib.suppress(Exception):  # it is reported when a report is to be drawn
        _drawing()


def night_facts(
    dataset: str, night: str, nights: Sequence[str], folder: Path | None = None
) -> NightFacts:
    """Return what the report of a night says.

    Parameters
    ----------
    nights
        All nights of the dataset, in order: those before this one are its trend.
    folder
        A local folder that has the night's tables too.
    """
    before = [each for each in nights if each < night][-(MAX_NIGHTS - 1) :]
    reader = (
        night_reader(dataset, night) if folder is None else NightReader.of_folder(folder, night)
    )
    return read_night_facts(reader, dataset, [night_reader(dataset, each) for each in before])


def _page_and_extract(facts: NightFacts) -> tuple[str, ReportExtract]:
    night_page, report_extract = _drawing()
    return night_page(facts), report_extract(facts)


def _drawing() -> tuple[Callable[[NightFacts], str], Callable[[NightFacts], ReportExtract]]:
    # Without matplotlib these modules cannot be imported: they raise `ReportError`.
    from epipole.tasks.report.page import night_page, report_extract

    return night_page, report_extract

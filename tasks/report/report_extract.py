"""What Prefect's page shows of a report: the most telling pictures, and the gaps of sensors."""

from typing import NamedTuple

from epipole.tasks.report.frame_series import Gap


class PagePicture(NamedTuple):
    """A PNG, and the sentence that stands for it."""

    alt: str
    png: bytes


class ReportExtract(NamedTuple):
    """The extract of one night; `lost_s` is the length of all gaps by sensor."""

    night: str
    pictures: tuple[PagePicture, ...]
    gaps: tuple[Gap, ...]
    lost_s: dict[str, float]

"""Which logs a run reads, and which night it makes of them."""

import datetime
import logging
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, NamedTuple

import numpy as np
import pyarrow as pa
from pydantic import Field

from epipole.io.logs.listing import list_logs
from epipole.io.logs.logged_times import read_log_times
from epipole.schemas.dates import YESTERDAY, ends_of, nights_before, nights_from
from epipole.schemas.errors import EpipoleError, LogError, NoFramesError
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.spans import DAY_NS, SPAN_NS
from epipole.schemas.text import as_line

# Logs that may have frames of a night.

LOGGER = logging.getLogger(__name__)

# A frame's time and the time it was logged at may differ by this much.
LOGGED_WITHIN_NS = 600_000_000_000
# Frames up to a span beyond both ends of a night are read too.
MARGIN_NS = SPAN_NS + LOGGED_WITHIN_NS


class FoundLogs(NamedTuple):
    """The logs of a night, and a row of `rejects` for each file that is not a log.

    `logged_ns` is when the first and the last message of a log were logged; it has no logs that
    may have frames of any night.
    """

    paths: list[str]
    rejects: pa.Table
    logged_ns: Mapping[str, tuple[int, int]] = {}

    def of(self, night: str) -> list[str]:
        """Return the logs that may have frames of a night, or of a margin before and after it."""
        logged = self.logged_ns
        return [p for p in self.paths if p not in logged or _touches(logged[p], night)]


def find_logs(
    where: str | Sequence[str],
    night: str | None,
    logged: dict[str, tuple[int, int] | None] | None = None,
) -> FoundLogs:
    """Return the logs that may have frames of a night or of a margin before and after it.

    Parameters
    ----------
    where
        A file, folder, glob or URL, or several; see `list_logs`. A log listed twice counts once.
    night
        UTC date, ``YYYY-MM-DD``; None: all logs.
    logged
        What `read_log_times` has returned by path; filled, for the next night of the same logs.

    Raises
    ------
    LogError
        If there are no logs, none of the night, or a log that was named is not MCAP.

    Notes
    -----
    A log that is named itself is always taken. Logs found in a folder or by a glob are chosen by
    the times at which their messages were logged. A log that does not tell them is taken too. A
    found file that is not MCAP is left out with a warning, so that one broken recording does not
    stop every night.
    """
    named = [where] if isinstance(where, str) else list(where)
    if not named:
        raise LogError("no logs given; name a log, or a folder of logs")
    chosen: list[str] = []
    known_ns: dict[str, tuple[int, int]] = {}
    spans: list[tuple[int, int]] = []
    broken: list[tuple[str, Reason, int | None]] = []
    logged = {} if logged is None else logged
    for path, is_named in _listed(named).items():
        try:
            logged_ns = logged[path] if path in logged else read_log_times(path)
        except LogError as error:
            if is_named or error.__cause__ is not None:  # it may be a log that cannot be read
                raise
            LOGGER.warning("left out: %s", error)
            broken.append((path, Reason.NO_MCAP, None))
            continue
        if path not in logged and logged_ns is None and not is_named:
            size = size_if_empty(path)
            if size is not None:
                LOGGER.warning("left out: %s: %s", path, Reason.NOTHING_READ.sentence)
                broken.append((path, Reason.NOTHING_READ, size))
                continue
        logged[path] = logged_ns
        if not is_named and logged_ns is not None:
            known_ns[path] = logged_ns
        if is_named or night is None or logged_ns is None or _touches(logged_ns, night):
            chosen.append(path)
        else:
            spans.append(logged_ns)
    if not chosen:
        kind = NoFramesError if spans else LogError
        raise kind(f"{', '.join(named)}: {_none_chosen(night, spans, len(broken))}")
    return FoundLogs(chosen, _rejects(broken), known_ns)


def name_of(path: str) -> str:
    """Return the name of a log, without its folders."""
    return path.rstrip("/").rpartition("/")[2]


def _listed(named: Sequence[str]) -> dict[str, bool]:
    """Return each log once, and whether it was named itself or found."""
    listed: dict[str, bool] = {}
    for where in named:
        paths, is_named = list_logs(where)
        for path in paths:
            listed[path] = is_named or listed.get(path, False)
    return listed


def _touches(logged_ns: tuple[int, int], night: str) -> bool:
    start_ns = _start_ns(night)
    first_ns, last_ns = logged_ns
    return first_ns < start_ns + DAY_NS + MARGIN_NS and last_ns >= start_ns - MARGIN_NS


def size_if_empty(path: str) -> int | None:
    """Return the size of a log in which nothing can be used; None where something can."""
    from epipole.io.logs.reader import read_log_pieces  # not above: it is seldom needed

    size = None
    for piece in read_log_pieces(path):
        if piece.exposures.num_rows or piece.states.num_rows or piece.cameras.num_rows:
            return None
        size = piece.source.size if piece.source else None
    return size


def _none_chosen(night: str | None, spans: Sequence[tuple[int, int]], broken: int) -> str:
    if not spans:
        return f"none of {broken} files is an MCAP log of which anything can be used"
    first, last = (_date(f([span[i] for span in spans])) for i, f in ((0, min), (1, max)))
    have = first if first == last else f"{first} to {last}"
    return f"no frames on {night} in these logs; they have {have}"


def _rejects(broken: Sequence[tuple[str, Reason, int | None]]) -> pa.Table:
    return reject_rows(
        [reason for _, reason, _ in broken],
        source=[name_of(path) for path, *_ in broken],
        offset=[size for *_, size in broken],
        time=[0] * len(broken),
        count=[1] * len(broken),
    )


def end_ns(night: str) -> int:
    """Return when the messages of a night, and of its margin, have all been logged."""
    return _start_ns(night) + DAY_NS + MARGIN_NS


def _start_ns(night: str) -> int:
    return int(np.datetime64(night, "ns").astype(np.int64))


def _date(time_ns: int) -> str:
    return (
        datetime.datetime.fromtimestamp(time_ns // 1_000_000_000, datetime.UTC).date().isoformat()
    )


# The nights that a run is asked for; Prefect checks them before it creates a run.

LONGEST_NAME = 60  # of a log in a run's name

_DATE = r"\d{4}-\d\d-\d\d"
Night = Annotated[str | None, Field(pattern=f"^({_DATE}(/{_DATE})?|{YESTERDAY})$")]
LastNights = Annotated[int, Field(ge=1, le=366)]


def night_asked(night: str | None) -> str | None:
    """Return the UTC date that is asked for, the last one of a range; None: every night.

    Yesterday is the day before the run was scheduled, even if the run starts late.

    Raises
    ------
    EpipoleError
        If there is no such date, or a range ends before it begins.
    """
    if night is None:
        return None
    if night == YESTERDAY:
        from prefect.runtime import flow_run  # not above: an unchanged night needs no Prefect

        due: datetime.datetime = flow_run.scheduled_start_time
        return nights_before(due.astimezone(datetime.UTC).date().isoformat(), 1)[0]
    try:
        first, last = ends_of(night)
        nights = nights_from(first, last)
    except ValueError as error:
        raise EpipoleError(f"night {night}: no such date; give one such as 2019-04-01") from error
    if not nights:
        raise EpipoleError(f"night {night}: {last} is before {first}; give the first night first")
    return nights[-1]


def nights_asked_before(night: str | None, asked: str | None, last_nights: int) -> list[str]:
    """Return the nights that are asked for before the one of `night_asked`, in order."""
    if night is None or asked is None:
        return []
    if night == YESTERDAY:
        return nights_before(asked, last_nights - 1)
    return nights_from(ends_of(night)[0], asked)[:-1]


def run_name() -> str:
    """Return the name of a run on Prefect's page, such as ``night 2019-04-01``."""
    from prefect.runtime import flow_run  # not above, as in `night_asked`

    asked: dict[str, Any] = flow_run.parameters
    night = night_asked(YESTERDAY) if asked.get("night") == YESTERDAY else asked.get("night")
    return f"night {night}" if night else f"all nights of {_what(asked.get('logs'))}"


def _what(logs: Any) -> str:
    """Return what the logs are called: the name of the only one, or how many were given."""
    named = [logs] if isinstance(logs, str) else list(logs or ())
    if len(named) != 1:
        return f"{len(named)} logs"
    return as_line(named[0].rstrip("/").rpartition("/")[2] or named[0], LONGEST_NAME)

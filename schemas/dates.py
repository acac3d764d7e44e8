"""Dates that name nights. It imports no library: the command line checks options with it."""

import datetime
import re

# The years all of whose instants are nanoseconds since 1970 in 64 bits.
FIRST_YEAR, LAST_YEAR = 1678, 2261
YESTERDAY = "yesterday"  # the day before a run is due
LAST_NIGHTS = 3  # that are made with it: the log of one of them may come late
MONTH = 30  # nights that say what is usual: which sensors there are, which logs are broken
_DATE = re.compile(r"\d{4}-\d\d-\d\d", re.ASCII)


def is_night(text: object) -> bool:
    """Return whether a text is the name of a night: a UTC date such as ``2019-04-01``."""
    try:
        return (
            isinstance(text, str)
            and _DATE.fullmatch(text) is not None
            and FIRST_YEAR <= datetime.date.fromisoformat(text).year <= LAST_YEAR
        )
    except ValueError:
        return False


def ends_of(nights: str) -> tuple[str, str]:
    """Return the first and the last night of a range, as in ``2019-04-01/2019-04-30``, or of one.

    The texts are not checked.
    """
    first, _, last = nights.partition("/")
    return first, last or first


def nights_from(first: str, last: str) -> list[str]:
    """Return the nights from the first to the last, in order; none if the last is before it."""
    begin, end = datetime.date.fromisoformat(first), datetime.date.fromisoformat(last)
    return [(begin + datetime.timedelta(days=k)).isoformat() for k in range((end - begin).days + 1)]


def nights_before(night: str, count: int) -> list[str]:
    """Return the last nights before a night, in order."""
    day = datetime.date.fromisoformat(night)
    return [(day - datetime.timedelta(days=k)).isoformat() for k in range(count, 0, -1)]

"""Dates that name nights. It imports no library: the command line checks options with it."""

import datetime
import re

# The years all of whose instants are nanoseconds since 1970 in 64 bits.
FIRST_YEAR, LAST_YEAR = 1678, 2261
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

"""What several commands take, and its checks."""

from typing import Annotated

import typer

from epipole.schemas.dates import FIRST_YEAR, LAST_YEAR, is_night

Logs = Annotated[
    list[str], typer.Argument(metavar="LOG", help="MCAP files, folders, glob patterns or URLs.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")]


def check_night(night: str | None, option: str = "--night") -> None:
    """Raise unless a night is a date; None is no night."""
    if night is not None and not is_night(night):
        raise typer.BadParameter(
            f"{night!r} is not a date such as 2019-04-01, of the years {FIRST_YEAR} to {LAST_YEAR}",
            param_hint=option,
        )

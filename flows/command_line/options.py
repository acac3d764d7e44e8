"""What several commands take, and its checks."""

import datetime
from typing import Annotated

import typer

Logs = Annotated[
    list[str], typer.Argument(metavar="LOG", help="MCAP files, folders, glob patterns or URLs.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")]


def check_night(night: str | None, option: str = "--night") -> None:
    """Raise unless a night is a date; None is no night."""
    try:
        if night is not None and datetime.date.fromisoformat(night).isoformat() != night:
            raise ValueError(night)
    except ValueError:
        raise typer.BadParameter(
            f"{night!r} is not a date such as 2019-04-01", param_hint=option
        ) from None

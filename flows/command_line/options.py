"""What commands share: arguments, checks of what they take, and output."""

import inspect
import json
from collections.abc import Callable, Iterable
from typing import Annotated, Any

import typer

from epipole.schemas.dates import FIRST_YEAR, LAST_YEAR, is_night
from epipole.schemas.text import as_line

# Arguments, and their checks.

Logs = Annotated[
    list[str], typer.Argument(metavar="LOG", help="MCAP files, folders, glob patterns or URLs.")
]
Assume = Annotated[
    list[str] | None,
    typer.Option(
        metavar="SENSOR.NAME=VALUE",
        help="Read a sensor's log otherwise than it states: sat1.time=gps, *.states=TEME, "
        "sat1.position_unit=m; as the settings sensors.assume. More than once, if need be.",
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")]


def check_night(night: str | None, option: str = "--night") -> None:
    """Raise unless a night is a date or None."""
    if night is not None and not is_night(night):
        raise typer.BadParameter(
            f"{night!r} is not a date such as 2019-04-01, of the years {FIRST_YEAR} to {LAST_YEAR}",
            param_hint=option,
        )


# Output: lines or JSON; help texts.


def print_lines(lines: Iterable[str], to_errors: bool = False) -> None:
    """Print lines that may have names from a log in them."""
    for line in lines:
        typer.echo(as_line(line), err=to_errors)


def help_text(command: Callable[..., Any]) -> str:
    """Return a command's help: each paragraph is one line, which the terminal's width breaks."""
    paragraphs = (inspect.getdoc(command) or "").split("\n\n")
    return "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


def print_json(value: Any) -> None:
    typer.echo(json.dumps(value, indent=2))

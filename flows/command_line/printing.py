"""What commands print on standard output: lines, or JSON."""

import json
from collections.abc import Iterable
from typing import Any

import typer

from epipole.schemas.text.shown import as_line


def print_lines(lines: Iterable[str], to_errors: bool = False) -> None:
    """Print lines that may have names from a log in them."""
    for line in lines:
        typer.echo(as_line(line), err=to_errors)


def print_json(value: Any) -> None:
    typer.echo(json.dumps(value, indent=2))

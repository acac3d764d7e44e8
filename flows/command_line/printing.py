"""What commands print on standard output: lines, or JSON; and their help."""

import inspect
import json
from collections.abc import Callable, Iterable
from typing import Any

import typer

from epipole.schemas.text.shown import as_line


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

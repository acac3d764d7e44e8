"""The command line: the program `epipole`, and how its commands end.

What a command needs is imported when it runs, so that ``epipole --help`` answers at once.
"""

import contextlib
import errno
import gc
import os
import sys
from collections.abc import Iterator
from importlib.metadata import version
from typing import Annotated, Any, NoReturn

import typer
import typer.core

from epipole.flows.command_line import nights, prune, run, simulate, tools
from epipole.flows.command_line.options import help_text
from epipole.flows.command_line.process import (
    prepare_environment,
    stop_by_signals,
    stopped_in_one_line,
    tells_compiling,
)
from epipole.io.paths import LONGEST_PATH, known_as
from epipole.schemas.errors import EpipoleError
from epipole.schemas.text import LONGEST_LINE, as_line, without_secrets

# Errors of files that a user can put right, wherever they are met.
_OF_USERS = {
    errno.ENAMETOOLONG: "the name is too long; give a shorter one",
    errno.EACCES: "may not be read or written; see who may enter its folder",
}


class _Commands(typer.core.TyperGroup):
    """Commands that end in one line where the user can put the error right."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Take the secrets out of URLs: no command shows or stores them."""
        for arg in args:
            if "\0" in arg or ("://" not in arg and len(os.fsencode(arg)) > LONGEST_PATH):
                _fail(f"{as_line(arg, 60)}: is too long, or has a zero character; give another one")
        shown = [known_as(arg) for arg in args]
        if len(set(shown)) < len(set(args)):
            _fail("two of the URLs differ only in their passwords or queries; give one of them")
        return super().parse_args(ctx, shown)

    def invoke(self, ctx: Any) -> Any:
        """Run the command. An error that is not the user's shows its traceback."""
        try:
            with stopped_in_one_line():
                return super().invoke(ctx)
        except EpipoleError as error:
            _fail(str(error))
        except OSError as error:
            if (says := _OF_USERS.get(error.errno or 0)) is None:
                raise
            _fail(f"{as_line(error.filename, 60)}: {says}")


def _fail(message: str) -> NoReturn:
    line = without_secrets(" ".join(message.split()))
    if len(line) > LONGEST_LINE:  # a long name must not hide the reason, which stands at the end
        line = f"{line[: LONGEST_LINE // 2]}...{line[-LONGEST_LINE // 3 :]}"
    print(f"epipole: {as_line(line)}", file=sys.stderr)
    sys.exit(1)


app = typer.Typer(
    name="epipole",
    cls=_Commands,
    help="Turns logs of star sensors into positions of space objects.",
    epilog="A first run: epipole simulate four_sensor_geo --out night.mcap; "
    "epipole run night.mcap --out out/",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Run the command line."""
    stop_by_signals()
    try:
        prepare_environment()
    except EpipoleError as error:
        _fail(str(error))
    with _little_collection():
        app()


@contextlib.contextmanager
def _little_collection() -> Iterator[None]:
    """Let Python look for garbage seldom: nearly all objects belong to libraries, and stay.

    Measured on a run of the example: 0.8 s less during it, 0.9 s less at its end.
    """
    gc.set_threshold(50_000, 20, 100)
    try:
        yield
    finally:
        gc.freeze()  # or the end of the program goes through all of them once more


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"epipole {version('epipole')}")
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print version."),
    ] = False,
) -> None:
    """Options of every command."""


app.command(help=help_text(run.run))(run.run)  # shows by itself what it compiles
for command in (
    nights.nights,
    prune.prune,
    tools.info,
    tools.doctor,
    tools.calibrate,
    simulate.simulate,
    tools.evaluate,
    tools.export,
    tools.overlay,
    tools.report,
    tools.settings,
    tools.deploy_files,
):
    app.command(help=help_text(command))(tells_compiling(command))
app.add_typer(tools.app, name="catalog")

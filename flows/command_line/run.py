"""`epipole run`: logs to a dataset, now."""

import datetime
import os
import warnings
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from epipole.flows.command_line.options import (
    AsJson,
    Assume,
    Logs,
    check_night,
    print_json,
    print_lines,
)
from epipole.flows.prefect.server_process import Launched, launch
from epipole.schemas.dates import LAST_NIGHTS, YESTERDAY, nights_before, nights_from
from epipole.schemas.options import Runner

if TYPE_CHECKING:  # imported when the command runs
    from epipole.flows.command_line.run_nightly import Ended


def run(
    logs: Logs,
    out: Annotated[
        str,
        typer.Option(
            metavar="DATASET", help="Folder or s3:// URL to publish to. Created if missing."
        ),
    ],
    settings: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Settings in TOML; `epipole settings` prints them all."),
    ] = None,
    assume: Assume = None,
    night: Annotated[
        str | None,
        typer.Option(
            metavar="DATE", help=f"Publish only this UTC date: YYYY-MM-DD, or {YESTERDAY}."
        ),
    ] = None,
    to: Annotated[
        str | None,
        typer.Option(metavar="DATE", help="With --night: every night to this one, one by one."),
    ] = None,
    last_nights: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=366,
            metavar="N",
            help=f"With --night {YESTERDAY}: the last N nights, where one has changed; "
            f"default: {LAST_NIGHTS}.",
        ),
    ] = None,
    stale: Annotated[
        bool,
        typer.Option(
            "--stale",
            help="Make the nights again that `epipole nights` calls stale, or whose logs changed.",
        ),
    ] = False,
    again: Annotated[
        bool, typer.Option("--again", help="Make a night again even if nothing has changed.")
    ] = False,
    replace: Annotated[
        bool,
        typer.Option(
            "--replace", help="Replace a night even if one of its earlier logs is not given."
        ),
    ] = False,
    known: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="Name known objects by these element sets: TLE, or OMM in CSV, JSON or XML.",
        ),
    ] = None,
    runner: Annotated[
        Runner, typer.Option(help="Run the tasks in threads or with Dask.")
    ] = Runner.threads,
    workers: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Tasks at the same time; default: one per CPU."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="A running Dask scheduler; default: Dask on this machine."
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print only errors.")] = False,
    verbose: Annotated[
        bool,
        typer.Option("--verbose", help="Also print the log lines of all tasks and of Prefect."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Turn logs into a dataset: run the nightly flow on this machine now.

    A night that is published, and was made from the same logs with the same settings by
    the same code, is not made again.
    """
    if not verbose:
        warnings.simplefilter("ignore")
    if stale and (night is not None or to is not None):
        raise typer.BadParameter(
            "it chooses the nights itself; leave --night and --to out", param_hint="--stale"
        )
    dates = _dates(night, to, last_nights)
    early = _early_server(out, dates[-1], again)
    from epipole.flows.command_line.run_nightly import Nights, RunOptions

    options = RunOptions(
        settings,
        replace,
        known,
        again,
        runner,
        workers,
        scheduler,
        quiet,
        verbose,
        tuple(assume or ()),
    )
    nights = Nights(logs, out, options, early)
    if len(dates) == 1 and to is None and not stale:
        (ended,) = nights.run(dates, alone=True)
        _print_one(ended, quiet, as_json)
    elif _print_each(nights.run(nights.stale() if stale else dates), quiet, as_json):
        raise typer.Exit(1)


def _early_server(out: str, night: str | None, again: bool) -> Launched | None:
    """Launch Prefect's server at once where it is needed for sure: its start takes longest."""
    pattern = f"night={night or '*'}"
    if "PREFECT_API_URL" in os.environ or "://" in out:
        return None
    return launch({}) if again or not any(Path(out).glob(pattern)) else None


def _dates(night: str | None, to: str | None, last_nights: int | None) -> Sequence[str | None]:
    """Return the nights that are asked for, in order; None: every night of the logs."""
    if night == YESTERDAY and to is None:
        today = datetime.datetime.now(datetime.UTC).date().isoformat()
        return nights_before(today, last_nights or LAST_NIGHTS)
    if last_nights is not None:
        raise typer.BadParameter(f"give it with --night {YESTERDAY}", param_hint="--last-nights")
    check_night(night)
    if to is None:
        return [night]
    check_night(to, "--to")
    if night is None:
        raise typer.BadParameter("give the first night by --night", param_hint="--to")
    nights = nights_from(night, to)
    if not nights:
        raise typer.BadParameter(f"{to} is before {night}", param_hint="--to")
    return nights


def _print_one(ended: "Ended", quiet: bool, as_json: bool) -> None:
    assert ended.summary is not None  # else its error was raised
    if as_json:
        print_json(ended.summary.as_dict() | {"seconds": round(ended.seconds, 2)})
    elif not quiet:
        print_lines([*ended.summary.lines(), f"took        {ended.seconds:.1f} s"])


def _print_each(all_ended: Iterable["Ended"], quiet: bool, as_json: bool) -> bool:
    """Print how each night ended as soon as it has; return whether any has failed."""
    printed = []
    for ended in all_ended:
        printed.append(ended)
        if not (quiet or as_json):
            print_lines([f"{ended.night}  {ended.line()}"])
        elif ended.error is not None:
            print_lines([f"epipole: {ended.night}: {ended.error}"], to_errors=True)
    if as_json:
        print_json([ended.as_dict() for ended in printed])
    elif not quiet:
        counts = Counter(ended.outcome for ended in printed)
        print_lines([", ".join(f"{n} {outcome}" for outcome, n in counts.items()) or "no night"])
    return any(ended.error is not None for ended in printed)

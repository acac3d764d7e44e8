"""`epipole run`: logs to a dataset, now."""

import warnings
from pathlib import Path
from typing import Annotated

import typer

from epipole.flows.command_line.options import AsJson, Logs, check_night
from epipole.flows.command_line.printing import print_json, print_lines
from epipole.schemas.choices import Runner


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
    night: Annotated[
        str | None, typer.Option(metavar="DATE", help="Publish only this UTC date (YYYY-MM-DD).")
    ] = None,
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
    """Turn logs into a dataset: run the nightly flow on this machine now."""
    if not verbose:
        warnings.simplefilter("ignore")
    from epipole.flows.command_line.run_nightly import RunOptions, run_nightly

    check_night(night)
    options = RunOptions(
        settings, night, replace, known, runner, workers, scheduler, quiet, verbose
    )
    summary, seconds = run_nightly(logs, out, options)
    if as_json:
        print_json(summary.as_dict() | {"seconds": round(seconds, 2)})
    elif not quiet:
        print_lines([*summary.lines(), f"took        {seconds:.1f} s"])

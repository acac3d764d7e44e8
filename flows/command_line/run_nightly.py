"""The nightly flow started from the command line, on an embedded Prefect."""

import logging
import time
from dataclasses import dataclass
from pathlib import Path

from epipole.flows.night.progress import prepare, shown
from epipole.flows.night.summary import Summary
from epipole.io.caches.kernel_warm_up import compile_beside
from epipole.io.catalogues.known_objects import read_known_objects
from epipole.io.catalogues.star_catalogue import check_star_catalogue
from epipole.io.datasets.dataset import check_folder
from epipole.io.logs.listing import list_logs
from epipole.io.settings_file import read_settings
from epipole.schemas.choices import Runner
from epipole.schemas.settings import Settings

LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class RunOptions:
    """The options of a run."""

    settings: Path | None = None
    night: str | None = None
    replace: bool = False
    known: str | None = None
    runner: Runner = Runner.threads
    workers: int | None = None
    scheduler: str | None = None
    quiet: bool = False
    verbose: bool = False


def run_nightly(logs: list[str], out: str, options: RunOptions) -> tuple[Summary, float]:
    """Return what a run found, and how many seconds it took.

    Raises
    ------
    EpipoleError
        Where the work cannot be done. Settings, catalogue, output and logs are checked before
        Prefect starts.
    """
    started = time.monotonic()
    settings = read_settings(options.settings) if options.settings else Settings()
    check_folder(out)
    check_star_catalogue(settings.identification.catalogue)
    if options.known is not None:
        read_known_objects(options.known)
    for where in logs:
        list_logs(where)
    with shown(options.quiet, options.verbose), compile_beside() as compiling:
        prepare("start Prefect")
        from epipole.flows.prefect.defaults import (
            embedded_prefect,
            lost_server_as_line,
            quiet_console,
        )
        from epipole.flows.prefect.runners import check_scheduler, task_runner

        if not options.verbose:
            quiet_console()
        if compiling:
            LOGGER.info("first run of this version: compiling takes about a minute")
        runner = task_runner(options.runner, options.workers, options.scheduler)
        if options.scheduler is not None:
            check_scheduler(options.scheduler)
        with embedded_prefect():
            from epipole.flows.nightly import nightly

            flow = nightly.with_options(task_runner=runner)
            with lost_server_as_line():
                summary = flow(logs, out, settings, options.night, options.replace, options.known)
    return summary, time.monotonic() - started

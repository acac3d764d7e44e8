"""The nightly flow started from the command line, on an embedded Prefect."""

import contextlib
import logging
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from epipole.flows.command_line.process import is_stopping
from epipole.flows.command_line.terminal import shown
from epipole.flows.night.log_choice import find_logs
from epipole.flows.night.progress import compile_step, prepare
from epipole.flows.night.recorded_nights import published_night, unchanged_nights
from epipole.flows.night.run_records import Stopwatch, record_unchanged, write_record
from epipole.flows.night.summary import Summary, summarise
from epipole.flows.prefect.server_process import Launched, launch
from epipole.io.caches.kernel_compiler import (
    compile_kernels,
    compiled_share,
    report_compiling,
    second_process,
)
from epipole.io.caches.kernels import kernel_folder
from epipole.io.catalogues.element_sets import read_known_objects
from epipole.io.catalogues.star_catalogue import check_star_catalogue
from epipole.io.datasets.dataset import (
    check_folder,
    finish_publication,
    night_location,
    nights_in,
)
from epipole.io.logs.listing import list_logs
from epipole.io.paths import line_of
from epipole.io.settings_file import run_settings
from epipole.schemas.errors import EpipoleError, NoFramesError
from epipole.schemas.options import Runner
from epipole.schemas.run_record import RunState

LOGGER = logging.getLogger(__name__)

WARM_SHARE = 0.5  # of the kernels: with more, one process compiles the others soon


@dataclass(frozen=True)
class RunOptions:
    """The options of a run, but for the nights."""

    settings: Path | None = None
    replace: bool = False
    known: str | None = None
    again: bool = False
    runner: Runner = Runner.threads
    workers: int | None = None
    scheduler: str | None = None
    quiet: bool = False
    verbose: bool = False
    assume: tuple[str, ...] = ()


@dataclass(frozen=True)
class Ended:
    """How the run of a night ended: with a summary, or with the reason why it failed."""

    night: str | None
    summary: Summary | None
    seconds: float
    error: str | None = None  # None without a summary: the logs have no frames of the night

    @property
    def outcome(self) -> str:
        """How it ended, in a word or three."""
        if self.summary is None:
            return "without frames" if self.error is None else "failed"
        return "unchanged" if self.summary.unchanged else "made"

    def line(self) -> str:
        """Return what was made, or why nothing was."""
        if self.summary is None:
            return f"failed: {self.error}" if self.error is not None else "no frames"
        if self.summary.unchanged:
            return "unchanged"
        return f"{self.summary.sentence()} ({self.seconds:.0f} s)"

    def as_dict(self) -> dict[str, Any]:
        """Return how it ended as JSON takes it."""
        summary = None if self.summary is None else self.summary.as_dict()
        return {
            "night": self.night, "outcome": self.outcome, "seconds": round(self.seconds, 2),
            "error": self.error, "summary": summary,
        }  # fmt: skip


class Nights:
    """Runs of the nightly flow, a night each; Prefect starts with the first that needs it."""

    def __init__(
        self, logs: list[str], out: str, options: RunOptions, early: Launched | None = None
    ) -> None:
        """Check settings, catalogues, output and logs.

        `early` is a process of Prefect's server that was launched before.

        Raises
        ------
        EpipoleError
            Where one of them cannot be used.
        """
        self._logs, self._out, self._options, self._early = logs, out, options, early
        self._settings = run_settings(options.settings, options.assume)
        check_folder(out)
        check_star_catalogue(self._settings.identification.catalogue)
        known = read_known_objects(options.known) if options.known is not None else None
        self._known_key = known.sha256 if known else None
        for where in logs:
            list_logs(where)
        self._logged: dict[str, tuple[int, int] | None] = {}

    def run(self, nights: Iterable[str | None], alone: bool = False) -> Iterator[Ended]:
        """Run the flow for each night, and yield how it ended.

        A night that fails does not stop those after it; the only one (`alone`) raises its error.
        """
        options = self._options
        with shown(options.quiet, options.verbose), contextlib.ExitStack() as started:
            make: Callable[[str | None], Summary] | None = None
            for night in nights:
                begun = time.monotonic()
                error, summary = None, None
                try:
                    summary = self._unchanged(night)
                    if summary is None:
                        make = make or self._start(started)
                        summary = make(night)
                except Exception as failed:  # whatever it is
                    if alone or is_stopping():
                        raise
                    if not isinstance(failed, EpipoleError):  # a fault of the program
                        traceback.print_exc()
                    error = None if isinstance(failed, NoFramesError) else line_of(failed)
                yield Ended(night, summary, time.monotonic() - begun, error)

    def stale(self) -> Iterator[str]:
        """Yield the published nights that a run of these logs and settings would make otherwise.

        Each is judged when those before it are made: it may depend on them.
        """
        given = find_logs(self._logs, None, self._logged)
        finish_publication(self._out)
        for date in nights_in(self._out):
            night = published_night(self._out, date, self._settings, self._known_key, given)
            if night.stale:
                yield night.date

    def _unchanged(self, night: str | None) -> Summary | None:
        """Return the summary of what need not be made again. This needs no Prefect.

        A night of which the logs cannot be found or read is recorded here: no flow run does it.
        """
        if self._options.again:
            return None
        used = Stopwatch.start()
        try:
            given = find_logs(self._logs, night, self._logged)
        except EpipoleError as error:
            if night is not None:
                is_empty = isinstance(error, NoFramesError)
                state = RunState.NO_FRAMES if is_empty else RunState.FAILED
                write_record(self._out, night, state, line_of(error), used, self._settings)
            raise
        same = unchanged_nights(self._out, given, night, self._settings, self._known_key)
        locations = {date: night_location(self._out, date) for date in same}
        if not same:
            return None
        summary = summarise(self._out, locations, unchanged=True)
        return record_unchanged(summary, used, self._settings)

    def _start(self, started: contextlib.ExitStack) -> Callable[[str | None], Summary]:
        """Start Prefect, and return what makes a night."""
        options = self._options
        started.enter_context(report_compiling(compile_step))
        prepare("start Prefect")
        early = self._early or launch({})  # it imports Prefect while this process does
        self._early = None
        from epipole.flows.prefect.defaults import (
            embedded_prefect,
            lost_server_as_line,
            quiet_console,
        )
        from epipole.flows.prefect.runners import check_scheduler, task_runner

        if not options.verbose:
            quiet_console()
        runner = task_runner(options.runner, options.workers, options.scheduler)
        if options.scheduler is not None:
            check_scheduler(options.scheduler)
        from epipole.flows.night.reports import load_drawing
        from epipole.flows.nightly import nightly
        from epipole.flows.prefect.artifacts import run_here

        # Done now, and not when they are needed: the server still starts.
        if self._settings.report.write:
            load_drawing()
        _load_kernels()
        started.enter_context(embedded_prefect(early))
        flow = nightly.with_options(task_runner=runner)

        def make(night: str | None) -> Summary:
            with lost_server_as_line():
                return run_here(
                    flow, self._logs, self._out, self._settings, night, options.replace,
                    options.known, options.again,
                )  # fmt: skip

        return make


def _load_kernels() -> None:
    """Load the compiled kernels; compile them where this package came without.

    Where the user has named a folder for numba, each is loaded or compiled as it is needed.
    """
    if kernel_folder() is None:
        return
    if compiled_share() > WARM_SHARE:
        compile_kernels()
        return
    LOGGER.info(
        "this installation has no compiled kernels: compiling takes one to two minutes, once"
    )
    with second_process():
        compile_kernels()

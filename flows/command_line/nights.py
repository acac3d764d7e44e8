"""`epipole nights`: what is in a dataset."""

import itertools
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer

from epipole.flows.command_line.options import AsJson, Assume, print_json, print_lines

if TYPE_CHECKING:  # imported when the command runs
    from epipole.flows.night.recorded_nights import PublishedNight

HEADINGS = ("night", "frames", "stars", "objects", "positions", "left out", "")
WIDTHS = (10, 11, 10, 9, 11, 10)
INDENT = " " * 12
NOT_RUN = "not run"  # nobody has asked for the date
MAX_NOT_RUN = 60  # such dates in succession; more are one line: a sensor's clock may say 1980


def nights(
    dataset: Annotated[
        str,
        typer.Argument(metavar="DATASET", help="Folder or URL that `epipole run` published to."),
    ],
    stale: Annotated[bool, typer.Option("--stale", help="Only nights that are stale.")] = False,
    settings: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings of the next run, in TOML.")
    ] = None,
    assume: Assume = None,
    known: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Catalogue of known objects of the next run."),
    ] = None,
    clear: Annotated[
        bool, typer.Option("--clear", help="Remove the unfinished work of stopped runs.")
    ] = False,
    runs: Annotated[
        bool, typer.Option("--runs", help="Also show what the last run of each night took.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Show the nights of a dataset: what each contains, what needs a look, which are stale.

    Dates between them that have no night are listed too: no frames, failed, or not run.

    A night is stale if a run would make it otherwise today: other code, settings or
    catalogues, or another night before it, whose objects it follows. `epipole run
    LOG... --stale` makes these again, and those whose logs have changed.
    """
    from epipole.flows.night.recorded_nights import published_nights
    from epipole.flows.night.run_records import all_dates, read_records
    from epipole.io.catalogues.element_sets import read_known_objects
    from epipole.io.catalogues.star_catalogue import check_star_catalogue
    from epipole.io.datasets.dataset import require_dataset
    from epipole.io.settings_file import run_settings
    from epipole.io.work.folder import clear_unfinished, unfinished_work

    require_dataset(dataset)
    today = run_settings(settings, assume or ())
    check_star_catalogue(today.identification.catalogue)
    known_key = read_known_objects(known).sha256 if known else None
    published = {n.date: n for n in published_nights(dataset, today, known_key)}
    records = read_records(dataset)
    dates = list(published) if stale else all_dates([*published, *records])
    found = [
        _Listed(date, published.get(date), records.get(date, {}))
        for date in dates
        if not stale or published[date].stale
    ]
    unfinished = clear_unfinished(dataset) if clear else unfinished_work(dataset)
    if as_json:
        print_json(
            {
                "nights": [night.as_dict() for night in found],
                "unfinished": [{"night": u.night, "bytes": u.size} for u in unfinished],
            }
        )
        return
    print_lines(_line(HEADINGS) for _ in found[:1])
    print_lines(_lines(found, runs))
    if not found:
        print_lines(["no night is stale" if stale else "no nights"])
    what = "removed" if clear else "unfinished; the next run continues it, --clear removes it"
    print_lines(
        f"{u.night}  {u.size / 2**20:,.0f} MiB of a stopped run: {what}" for u in unfinished
    )


def _lines(found: "Sequence[_Listed]", runs: bool) -> Iterator[str]:
    """Return the dates as people read them."""
    for is_idle, dates in itertools.groupby(found, lambda each: each.state == NOT_RUN):
        listed = list(dates)
        if is_idle and len(listed) > MAX_NOT_RUN:
            yield f"{listed[0].date} to {listed[-1].date}  {NOT_RUN}"
        else:
            yield from (line for night in listed for line in night.lines(runs))


class _Listed(NamedTuple):
    """A date: its published night, if there is one, and the record of its last run, or none."""

    date: str
    night: "PublishedNight | None"
    record: dict[str, Any]

    @property
    def state(self) -> str:
        """How its last run ended; no night and no record: nobody has asked for it."""
        return self.record.get("state") or ("made" if self.night else NOT_RUN)

    def as_dict(self) -> dict[str, Any]:
        """Return the date as JSON takes it."""
        night = {"stale": []} if self.night is None else self.night.as_dict()
        ended = self.record.get("ended")
        record = self.record | ({} if ended is None else {"ended": f"{ended:%Y-%m-%dT%H:%M:%SZ}"})
        return {**night, **record, "night": self.date, "state": self.state}

    def lines(self, runs: bool) -> list[str]:
        """Return the date as people read it: a line, one for each further thing, and the run."""
        state = [] if self.state == "made" else [self.state]
        state += (
            [f"stale: {', '.join(self.night.stale)}"] if self.night and self.night.stale else []
        )
        sentences = self.record.get("needs_look", [])
        if self.state == "failed":
            sentences = [self.record["message"]]
        elif self.night is not None and not self.record:
            sentences = self.night.row.get("faults", [])
        lines = [_line((self.date, *self._counts(), "; ".join(state)))]
        lines += [f"{INDENT}{each}" for each in sentences]
        return [*lines, *(self._run() if runs and self.record else [])]

    def _counts(self) -> list[str]:
        row = {} if self.night is None else self.night.row
        if not row:
            return [""] * (len(WIDTHS) - 1)
        share = f"{100 * row['identified'] / row['frames']:.1f} %" if row["frames"] else ""
        counts = [f"{row[name]:,}" for name in ("objects", "positions", "left_out")]
        return [f"{row['frames']:,}", share, *counts]

    def _run(self) -> list[str]:
        record = self.record
        sensors = [] if self.night is None else self.night.row.get("sensor_ids", [])
        return [
            f"{INDENT}run {record['run_id'] or 'without Prefect'} on {record['host']}, ended "
            f"{record['ended']:%Y-%m-%d %H:%M:%S}: {record['duration_s']:.0f} s, "
            f"{record['cpu_s']:.0f} s of CPU, {record['memory_mib']:,.0f} MiB",
            f"{INDENT}{record['versions']}",
            *([f"{INDENT}sensors {', '.join(sensors)}"] if sensors else []),
            *([f"{INDENT}settings {', '.join(record['settings'])}"] if record["settings"] else []),
        ]


def _line(cells: tuple[str, ...]) -> str:
    first, *numbers, last = cells
    aligned = "".join(f"{n:>{width}}" for n, width in zip(numbers, WIDTHS[1:], strict=True))
    return f"{first:<{WIDTHS[0]}}{aligned}  {last}".rstrip()

"""`epipole nights`: what is in a dataset."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from epipole.flows.command_line.options import AsJson, print_json, print_lines

if TYPE_CHECKING:  # imported when the command runs
    from epipole.flows.night.recorded_nights import PublishedNight

HEADINGS = ("night", "frames", "stars", "objects", "positions", "left out", "")
WIDTHS = (10, 11, 10, 9, 11, 10)


def nights(
    dataset: Annotated[
        str,
        typer.Argument(metavar="DATASET", help="Folder or URL that `epipole run` published to."),
    ],
    stale: Annotated[bool, typer.Option("--stale", help="Only nights that are stale.")] = False,
    settings: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Settings of the next run, in TOML.")
    ] = None,
    known: Annotated[
        str | None,
        typer.Option(metavar="FILE", help="Catalogue of known objects of the next run."),
    ] = None,
    clear: Annotated[
        bool, typer.Option("--clear", help="Remove the unfinished work of stopped runs.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Show the nights of a dataset: what each contains, and which are stale.

    A night is stale if a run would make it otherwise today: other code, settings or
    catalogues, or another night before it, whose objects it follows. `epipole run
    LOG... --stale` makes these again, and those whose logs have changed.
    """
    from epipole.flows.night.recorded_nights import published_nights
    from epipole.io.catalogues.element_sets import read_known_objects
    from epipole.io.datasets.dataset import require_dataset
    from epipole.io.settings_file import read_settings
    from epipole.io.work.folder import clear_unfinished, unfinished_work
    from epipole.schemas.settings import Settings

    require_dataset(dataset)
    today = read_settings(settings) if settings else Settings()
    known_key = read_known_objects(known).sha256 if known else None
    found = [n for n in published_nights(dataset, today, known_key) if n.stale or not stale]
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
    print_lines(_night_line(night) for night in found)
    if not found:
        print_lines(["no night is stale" if stale else "no nights"])
    what = "removed" if clear else "unfinished; the next run continues it, --clear removes it"
    print_lines(
        f"{u.night}  {u.size / 2**20:,.0f} MiB of a stopped run: {what}" for u in unfinished
    )


def _night_line(night: "PublishedNight") -> str:
    row, state = night.row, f"stale: {', '.join(night.stale)}" if night.stale else ""
    if not row:
        return f"{night.date}  {state}"
    share = f"{100 * row['identified'] / row['frames']:.1f} %" if row["frames"] else ""
    counts = [f"{row[name]:,}" for name in ("objects", "positions", "left_out")]
    if row["faults"]:
        state = "; ".join([*row["faults"], *filter(None, [state])])
    return _line((night.date, f"{row['frames']:,}", share, *counts, state))


def _line(cells: tuple[str, ...]) -> str:
    first, *numbers, last = cells
    aligned = "".join(f"{n:>{width}}" for n, width in zip(numbers, WIDTHS[1:], strict=True))
    return f"{first:<{WIDTHS[0]}}{aligned}  {last}".rstrip()

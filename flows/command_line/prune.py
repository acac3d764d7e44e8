"""`epipole prune`: old nights, reports and work of a dataset."""

from typing import Annotated

import typer

from epipole.flows.command_line.options import AsJson, check_night, print_json, print_lines


def prune(
    dataset: Annotated[
        str,
        typer.Argument(metavar="DATASET", help="Folder or URL that `epipole run` published to."),
    ],
    nights: Annotated[
        str | None,
        typer.Option("--nights", metavar="DATE", help="Nights before this date, with all of them."),
    ] = None,
    reports: Annotated[
        str | None, typer.Option("--reports", metavar="DATE", help="Reports before this date.")
    ] = None,
    work: Annotated[
        bool, typer.Option("--work", help="The work of stopped runs, and work that is kept.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Remove them; else they are shown.")] = False,
    as_json: AsJson = False,
) -> None:
    """Show what a dataset has before a date, and remove it with --yes.

    Nights go with their reports and the records of their runs. A night on which a run
    works stays. The night after the last one removed is stale from then on.
    """
    from epipole.io.datasets.dataset import (
        finish_publication,
        locked_nights,
        remove,
        require_dataset,
        sizes,
    )
    from epipole.io.work.folder import clear_unfinished, unfinished_work

    check_night(nights, "--nights")
    check_night(reports, "--reports")
    if nights is None and reports is None and not work:
        raise typer.BadParameter("say what: --nights DATE, --reports DATE or --work")
    require_dataset(dataset)
    if yes:  # else a later run or reader would put back what a stopped one has published
        finish_publication(dataset)
    found = sizes(dataset)
    locked = locked_nights(dataset) if nights is not None else set()
    stay = sorted({date for date in map(_date, found) if date in locked and date < (nights or "")})
    chosen = {
        name: size
        for name, size in found.items()
        if (nights is not None and _date(name) < nights and _date(name) not in stay)
        or (reports is not None and name.startswith("reports/") and _date(name) < reports)
    }
    look = clear_unfinished if yes else unfinished_work
    left = look(dataset, kept=True) if work else []
    if yes:
        remove(dataset, list(chosen))
    of_work = {f"work of {each.night}": each.size for each in left}
    if as_json:
        print_json({"removed": yes, "bytes": {**chosen, **of_work}, "locked": stay})
        return
    print_lines(f"night={date} stays: a run works on it" for date in stay)
    print_lines(
        f"{size / 2**20:>10,.1f} MiB  {name}" for name, size in {**chosen, **of_work}.items()
    )
    total = (sum(chosen.values()) + sum(of_work.values())) / 2**20
    what = "removed" if yes else "would be removed; --yes does it"
    print_lines([f"{total:>10,.1f} MiB  {what}" if chosen or of_work else "nothing to remove"])


def _date(name: str) -> str:
    """Return the date in the name of a night, a report or a record."""
    return name.removeprefix("night=").rpartition("/")[2].partition(".")[0]

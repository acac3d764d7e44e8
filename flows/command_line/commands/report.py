"""`epipole report`: a night as a page with pictures."""

from pathlib import Path
from typing import Annotated

import typer

from epipole.flows.command_line.options import AsJson, check_night
from epipole.flows.command_line.printing import print_json, print_lines


def report(
    dataset: Annotated[
        str,
        typer.Argument(metavar="DATASET", help="Folder or URL that `epipole run` published to."),
    ],
    night: Annotated[str, typer.Option(metavar="DATE", help="The night, a UTC date (YYYY-MM-DD).")],
    out: Annotated[Path, typer.Option(metavar="FILE", help="HTML file to write.")],
    as_json: AsJson = False,
) -> None:
    """Write the report of a night: one HTML file with pictures, which needs no other file.

    It needs the extra `report` (matplotlib).
    """
    from epipole.flows.report import report

    check_night(night)
    size = report(dataset, night, out)
    if as_json:
        print_json({"file": str(out), "bytes": size})
    else:
        print_lines([f"file    {out}", f"size    {size / 1e3:,.0f} kB"])

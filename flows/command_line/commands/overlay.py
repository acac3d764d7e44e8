"""`epipole overlay`: a night drawn over its logs."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from epipole.flows.command_line.options import AsJson, Logs, check_night
from epipole.flows.command_line.printing import print_json, print_lines


def overlay(
    dataset: Annotated[
        str,
        typer.Argument(metavar="DATASET", help="Folder or URL that `epipole run` published to."),
    ],
    logs: Logs,
    out: Annotated[Path, typer.Option(metavar="FILE", help="MCAP file to write.")],
    night: Annotated[
        str | None, typer.Option(metavar="DATE", help="Only this UTC date (YYYY-MM-DD).")
    ] = None,
    images: Annotated[
        bool, typer.Option("--images", help="Also draw an image for each frame from its centroids.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Draw a night over its logs, as an MCAP file for Foxglove and viewers like it.

    Stars ringed and named, objects with their ids, calibrations, sensors and objects in
    space with their lines of sight, and what was left out, at the frames' own times.
    Open it together with the log.
    """
    from epipole.flows.overlay import overlay as write

    check_night(night)
    made = write(dataset, logs, out, night, images)
    if as_json:
        print_json(asdict(made))
        return
    print_lines(
        [
            f"file    {made.out}",
            f"nights  {', '.join(made.nights)}",
            f"frames  {made.frames:,} annotated, {made.epochs:,} epochs",
            f"log     {made.log_lines:,} lines",
        ]
    )
    if made.without_rows:
        print_lines([f"        {made.without_rows:,} frames of the logs are not in the dataset"])

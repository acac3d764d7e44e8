"""`epipole export`: CCSDS messages."""

from pathlib import Path
from typing import Annotated

import typer

from epipole.flows.command_line.options import AsJson, check_night
from epipole.flows.command_line.printing import print_json, print_lines
from epipole.schemas.choices import Message


def export(
    message: Annotated[Message, typer.Argument(metavar="KIND", help="tdm, oem or opm.")],
    dataset: Annotated[
        str,
        typer.Argument(metavar="DATASET", help="Folder or URL that `epipole run` published to."),
    ],
    night: Annotated[str, typer.Option(metavar="DATE", help="The night, a UTC date (YYYY-MM-DD).")],
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder to write to, new or empty.")],
    object_ids: Annotated[
        list[str] | None,
        typer.Option("--object", metavar="ID", help="Only this object; may be given again."),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a night's objects as CCSDS messages for orbit determination (KVN).

    tdm: the directions of each object (TDM 2.0), with an ephemeris of each sensor

    oem: each object's states, moved through their arcs (OEM 3.0)

    opm: each state with its covariance (OPM 3.0)
    """
    from epipole.flows.export import export

    check_night(night)
    files = export(message, dataset, night, out, object_ids or ())
    if as_json:
        print_json({"folder": str(out), "files": files})
    else:
        print_lines([f"folder  {out}", f"files   {len(files)}: {files[0]} to {files[-1]}"])

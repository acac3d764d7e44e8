"""`epipole evaluate`: a dataset against its truth."""

from pathlib import Path
from typing import Annotated

import typer

from epipole.flows.command_line.options import AsJson
from epipole.flows.command_line.printing import print_json


def evaluate(
    dataset: Annotated[
        str,
        typer.Argument(metavar="DATASET", help="Folder or URL that `epipole run` published to."),
    ],
    truth: Annotated[
        Path, typer.Option(metavar="DIR", help="The folder LOG.truth beside the simulated log.")
    ],
    as_json: AsJson = False,
) -> None:
    """Compare a dataset with the truth of the simulated log it was made from.

    Shows the precision and recall of stars, pairs and objects, the errors of attitudes, positions
    and states, whether covariances agree with these errors, and objects that were lost.
    """
    from epipole.flows.evaluate import evaluate, show

    report = evaluate(dataset, truth)
    if as_json:
        print_json(report.as_dict())
    else:
        show(report)

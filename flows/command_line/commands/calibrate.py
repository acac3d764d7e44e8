"""`epipole calibrate`: the cameras of sensors."""

import sys
from typing import Annotated

import typer

from epipole.flows.command_line.options import AsJson, Logs
from epipole.flows.command_line.printing import print_json, print_lines


def calibrate(
    logs: Logs,
    field_deg: Annotated[
        float | None,
        typer.Option(
            "--field",
            min=0.5,
            max=120.0,
            metavar="DEG",
            help="Field of view along the columns, about; default: what the log says.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Find the cameras of sensors by their stars, and print calibrations for the log.

    For cameras that nobody calibrated, and for those that a run cannot identify: focal
    length, whether rows count upward, principal point and distortion.

    The focal length may be 1.5 times longer or shorter than the log or --field says. With
    neither, fields of 2 to 60 degrees are tried. At most 100 frames of each sensor are
    used. No log is changed.
    """
    from epipole.flows.calibrate import as_dict, lines
    from epipole.flows.calibrate import calibrate as calibrate_logs

    reports = calibrate_logs(logs, field_deg)
    if as_json:
        print_json([as_dict(report) for report in reports])
    else:
        print_lines(line for report in reports for line in lines(report))
    if not any(report.camera for report in reports):
        sys.exit(1)

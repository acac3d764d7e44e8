"""The commands beside `run`, `simulate` and `nights`: one function each, by its name.

Each function is a command: typer makes the options from its signature and the help from its
docstring. What a command needs is imported when it runs, so that `--help` stays fast.
"""

import os
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from epipole.flows.command_line.options import (
    AsJson,
    Assume,
    Logs,
    check_night,
    help_text,
    print_json,
    print_lines,
)
from epipole.flows.prefect.server_process import new_secret
from epipole.schemas.errors import EpipoleError
from epipole.schemas.options import STAR_CATALOGUES, Message, MessageForm, MessageFrame


def report(
    dataset: Annotated[
        str,
        typer.Argument(metavar="DATASET", help="Folder or URL that `epipole run` published to."),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="HTML file to write.")],
    night: Annotated[
        str | None,
        typer.Option(
            metavar="DATE",
            help="The night, a UTC date (YYYY-MM-DD); default: a calendar of all nights.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write the report of a night: one HTML file with pictures, which needs no other file.

    Without --night, a calendar of the nights, coloured by what is to be thought of them.

    A night needs the extra `report` (matplotlib).
    """
    from epipole.flows.report import report

    if night is not None:
        check_night(night)
    size = report(dataset, night, out)
    if as_json:
        print_json({"file": str(out), "bytes": size})
    else:
        print_lines([f"file    {out}", f"size    {size / 1e3:,.0f} kB"])


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
    assume: Assume = None,
    as_json: AsJson = False,
) -> None:
    """Find the cameras of sensors by their stars, and print calibrations for the log.

    For cameras that nobody calibrated, and for those that a run cannot identify: focal
    length, whether rows count upward, principal point and distortion.

    The focal length may be 1.5 times longer or shorter than the log or --field says. With
    neither, fields of 2 to 60 degrees are tried. At most 100 frames of each sensor are
    used; where its calibration changes, only those since. No log is changed.
    """
    from epipole.flows.calibrate import as_dict, lines
    from epipole.flows.calibrate import calibrate as calibrate_logs
    from epipole.schemas.given_settings import with_assumptions
    from epipole.schemas.settings import Settings

    reports = calibrate_logs(logs, field_deg, with_assumptions(Settings(), assume or ()))
    if as_json:
        print_json([as_dict(report) for report in reports])
    else:
        print_lines(line for report in reports for line in lines(report))
    if not any(report.camera for report in reports):
        sys.exit(1)


# `epipole catalog` has one command so far, `build`.
app = typer.Typer(help="Build a star catalogue for star identification.", no_args_is_help=True)


@app.callback()
def _catalog() -> None:
    """Make `build` a subcommand; typer would drop the name of a single command."""


def build(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help=f"{', '.join(STAR_CATALOGUES)}, or a CSV or Parquet file of stars.",
        ),
    ],
    out: Annotated[Path, typer.Option(metavar="FILE", help="Parquet file to write.")],
    epoch: Annotated[
        float | None,
        typer.Option(
            metavar="YEAR", help="Julian year of the positions in the file, such as 2016.0."
        ),
    ] = None,
    name: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Name of the catalogue; default: the name of the file."),
    ] = None,
    magnitude_limit: Annotated[
        float | None, typer.Option("--limit", metavar="MAG", help="Leave fainter stars out.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Write a star catalogue for the setting identification.catalogue.

    A file needs the columns star_id (whole numbers), ra_deg, dec_deg (ICRS) and
    magnitude (V). It may have pm_ra_mas_yr (times cos dec), pm_dec_mas_yr,
    parallax_mas, sigma_mas, pm_sigma_mas_yr (1-sigma per axis) and variable
    (true or false). Invalid rows are reported by number, from 1 without the header.
    """
    from epipole.flows.catalogue import build_catalogue

    built = build_catalogue(source, out, epoch, name, magnitude_limit)
    if as_json:
        print_json(built.as_dict())
    else:
        print_lines(built.lines())


_SOURCES = [f"{name}: {source.sentence}" for name, source in STAR_CATALOGUES.items()]
app.command(help="\n\n".join([help_text(build), *_SOURCES]))(build)


# The files of `epipole deploy-files`, and what each is for.
FILES = {
    "prefect.env": "settings of Prefect with a new secret; readable by you only",
    "prefect.yaml": "the deployment, for `prefect deploy --all`",
    "automations.yaml": "lost, failed and late runs: for `prefect automation create --from-file`",
    "epipole-server.service": "Prefect's server as a systemd unit",
    "epipole-worker.service": "a worker as a systemd unit",
    "Containerfile": "a worker in a container",
}
_SECRET = "@SECRET@"


def deploy_files(
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder to write to.")] = Path("."),
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there.")] = False,
) -> None:
    """Write the files of a nightly deployment: Prefect, systemd, container.

    docs/operations.md goes through them. A file that is there is not replaced. prefect.env has the
    secret that Prefect's server asks for; each call makes another one.
    """
    from importlib.resources import files

    there = [name for name in FILES if (out / name).exists()]
    if there and not force:
        raise EpipoleError(
            f"{out}: has {', '.join(there)}; nothing was written: give another folder, or --force"
        )
    source = files("epipole.flows.prefect") / "deploy_files"
    secret = new_secret()
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name in FILES:
            _write(out / name, (source / name).read_text(encoding="utf-8"), secret)
    except OSError as error:
        raise EpipoleError(f"{out}: cannot be written: {error.strerror}; give another") from error
    print_lines(f"{out / name!s:<26}  {use}" for name, use in FILES.items())


def _write(file: Path, text: str, secret: str) -> None:
    """Write a new file; one with the secret is readable by its owner only from the start."""
    file.unlink(missing_ok=True)
    mode = 0o600 if _SECRET in text else 0o666  # of which the user's umask takes its part
    # Not through a link that somebody has put there meanwhile.
    new = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
    with open(new, "w", encoding="utf-8") as opened:
        opened.write(text.replace(_SECRET, secret))


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


MAX_AHEAD_H = 21 * 24.0  # services that screen ephemerides take 21 days


def export(
    message: Annotated[Message, typer.Argument(metavar="KIND", help="tdm, oem, opm, ocm or ades.")],
    dataset: Annotated[
        str,
        typer.Argument(metavar="DATASET", help="Folder or URL that `epipole run` published to."),
    ],
    night: Annotated[str, typer.Option(metavar="DATE", help="The night, a UTC date (YYYY-MM-DD).")],
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder to write to, new or empty.")],
    object_ids: Annotated[
        list[str] | None,
        typer.Option(
            "--object",
            metavar="ID",
            help="Only this object, or tracklet of a tdm or ades; may be given again.",
        ),
    ] = None,
    frame: Annotated[
        MessageFrame,
        typer.Option(help="Reference frame of states and covariances; not of a tdm or ades."),
    ] = MessageFrame.GCRF,
    ahead_h: Annotated[
        float,
        typer.Option(
            "--ahead",
            min=0.0,
            max=MAX_AHEAD_H,
            metavar="HOURS",
            help="How long orbits go on after their arc, in an oem or ocm.",
        ),
    ] = 0.0,
    form: Annotated[
        MessageForm, typer.Option(help="Keywords with values (KVN), or XML; not of ades.")
    ] = MessageForm.kvn,
    as_json: AsJson = False,
) -> None:
    """Write a night's objects as messages for orbit determination: CCSDS (KVN, XML) or ADES (PSV).

    tdm: the directions of each object, and of tracklets without (TDM 2.0), with an ephemeris of
    each sensor

    oem: each object's orbit, or its states, moved through its arc (OEM 3.0)

    opm: each orbit, or state, with its covariance (OPM 3.0)

    ocm: as oem, with the numbers of a catalogue (OCM 3.0)

    ades: each direction with its sigmas, from where its sensor was (ADES 2022)
    """
    from epipole.flows.export import Wanted, export

    check_night(night)
    files = export(message, dataset, night, out, Wanted(object_ids or (), frame, ahead_h, form))
    if as_json:
        print_json({"folder": str(out), "files": files})
    else:
        print_lines([f"folder  {out}", f"files   {len(files)}: {files[0]} to {files[-1]}"])


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
    assume: Assume = None,
    as_json: AsJson = False,
) -> None:
    """Draw a night over its logs, as an MCAP file for Foxglove and viewers like it.

    Stars ringed and named, objects with their ids, calibrations, sensors and objects in
    space with their lines of sight, and what was left out, at the times of the frames.
    Open it together with the log, with the layout of panels that is written beside it.
    Logs that were run with --assume, or with the setting, need the same here.
    """
    from epipole.flows.overlay import overlay as write
    from epipole.schemas.given_settings import with_assumptions
    from epipole.schemas.settings import Settings

    check_night(night)
    read_as = with_assumptions(Settings(), assume or ()).sensors.assume
    made = write(dataset, logs, out, night, images, read_as)
    if as_json:
        print_json(asdict(made))
        return
    print_lines(
        [
            f"file    {made.out}",
            f"layout  {made.layout}",
            f"nights  {', '.join(made.nights)}",
            f"frames  {made.frames:,} annotated, {made.epochs:,} epochs",
            f"log     {made.log_lines:,} lines",
        ]
    )
    if made.without_rows:
        print_lines([f"        {made.without_rows:,} frames of the logs are not in the dataset"])


def settings() -> None:
    """Print all settings with their defaults, as TOML for `epipole run --settings`."""
    from epipole.io.settings_file import settings_text
    from epipole.schemas.settings import Settings

    typer.echo(settings_text(Settings()), nl=False)


def info(logs: Logs, as_json: AsJson = False) -> None:
    """Show what is in logs: sensors, times, counts, and what cannot be used.

    A file in a folder that cannot be read has a line, and the others are shown. It exits with 1
    then.
    """
    from epipole.flows.command_line.log_info import describe_found, lines
    from epipole.io.logs.listing import list_logs

    is_named: dict[str, bool] = {}
    for where in logs:
        found, is_one = list_logs(where)
        is_named |= {log: is_one or is_named.get(log, False) for log in found}
    described = [describe_found(log, named) for log, named in is_named.items()]
    if as_json:
        print_json(described)
    else:
        print_lines(line for log in described for line in lines(log))
    if any("error" in log for log in described):
        sys.exit(1)


def doctor(logs: Logs, assume: Assume = None, as_json: AsJson = False) -> None:
    """Check how logs were written, and name ordinary mistakes, each with its cure.

    For each sensor: units and reference frame of its states, velocities against positions,
    sigmas against scatter, times of frames against states, rounding of times, ids,
    principal point, image size and fluxes. What the log cannot show is said. Exits with 1
    where something is wrong. A run makes the same checks: its table checks.
    """
    from epipole.flows.doctor import as_dict, lines
    from epipole.flows.doctor import doctor as examine
    from epipole.schemas.given_settings import with_assumptions
    from epipole.schemas.settings import Settings

    found = examine(logs, with_assumptions(Settings(), assume or ()))
    if as_json:
        print_json(as_dict(found))
    else:
        print_lines(lines(found))
    if not found.is_sound:
        sys.exit(1)

"""The command line: ``epipole run``, ``simulate``, ``info``, ``calibrate``, ``evaluate``,
``export``, ``settings``, ``catalog build``.

What a command needs is imported when it runs, so that ``epipole --help`` answers at once.
"""

import datetime
import json
import sys
import warnings
from collections.abc import Iterable
from enum import StrEnum
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer
import typer.core

from epipole.flows.command_line.environment import prepare_environment
from epipole.flows.command_line.stopping import stop_by_signals, stopped_in_one_line
from epipole.io.logs.messages.encodings.registry import ENCODINGS
from epipole.schemas.choices import Message, Runner
from epipole.schemas.errors import EpipoleError
from epipole.schemas.text.shown import as_line


class _Commands(typer.core.TyperGroup):
    """Commands that end in one line where the user can put the error right."""

    def invoke(self, ctx: Any) -> Any:
        """Run the command. An error that is not the user's shows its traceback."""
        try:
            with stopped_in_one_line():
                return super().invoke(ctx)
        except EpipoleError as error:
            _fail(str(error))


def _fail(message: str) -> NoReturn:
    print(f"epipole: {as_line(' '.join(message.split()))}", file=sys.stderr)
    sys.exit(1)


app = typer.Typer(
    name="epipole",
    cls=_Commands,
    help="Turns logs of star sensors into positions of space objects.",
    epilog="A first run: epipole simulate four_sensor_geo --out night.mcap; "
    "epipole run night.mcap --out out/",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def main() -> None:
    """Run the command line."""
    stop_by_signals()
    try:
        prepare_environment()
    except EpipoleError as error:
        _fail(str(error))
    app()


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"epipole {version('epipole')}")
        raise typer.Exit


@app.callback()
def _options(
    _version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print version."),
    ] = False,
) -> None:
    """Options of every command."""


Logs = Annotated[
    list[str], typer.Argument(metavar="LOG", help="MCAP files, folders, glob patterns or URLs.")
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")]


# How the messages of a log are encoded.
Encoding = StrEnum("Encoding", {name: name for name in ENCODINGS})  # type: ignore[misc]


class Compression(StrEnum):
    """How the chunks of a log are compressed."""

    zstd = "zstd"
    lz4 = "lz4"
    none = "none"


@app.command()
def run(
    logs: Logs,
    out: Annotated[
        str,
        typer.Option(
            metavar="DATASET", help="Folder or s3:// URL to publish to. Created if missing."
        ),
    ],
    settings: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Settings in TOML; `epipole settings` prints them all."),
    ] = None,
    night: Annotated[
        str | None, typer.Option(metavar="DATE", help="Publish only this UTC date (YYYY-MM-DD).")
    ] = None,
    replace: Annotated[
        bool,
        typer.Option(
            "--replace", help="Replace a night even if one of its earlier logs is not given."
        ),
    ] = False,
    known: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="Name known objects by these element sets: TLE, or OMM in CSV, JSON or XML.",
        ),
    ] = None,
    runner: Annotated[
        Runner, typer.Option(help="Run the tasks in threads or with Dask.")
    ] = Runner.threads,
    workers: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Tasks at the same time; default: one per CPU."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", help="A running Dask scheduler; default: Dask on this machine."
        ),
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print only errors.")] = False,
    verbose: Annotated[
        bool,
        typer.Option("--verbose", help="Also print the log lines of all tasks and of Prefect."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Turn logs into a dataset: run the nightly flow on this machine now."""
    if not verbose:
        warnings.simplefilter("ignore")
    from epipole.flows.command_line.run import RunOptions, run_nightly

    _check_night(night)
    options = RunOptions(
        settings, night, replace, known, runner, workers, scheduler, quiet, verbose
    )
    summary, seconds = run_nightly(logs, out, options)
    if as_json:
        _print_json(summary.as_dict() | {"seconds": round(seconds, 2)})
    elif not quiet:
        _print_lines([*summary.lines(), f"took        {seconds:.1f} s"])


def _check_night(night: str | None) -> None:
    try:
        if night is not None and datetime.date.fromisoformat(night).isoformat() != night:
            raise ValueError(night)
    except ValueError:
        raise typer.BadParameter(
            f"{night!r} is not a date such as 2019-04-01", param_hint="--night"
        ) from None


@app.command()
def info(logs: Logs, as_json: AsJson = False) -> None:
    """Show what is in logs: sensors, times, counts, and what cannot be used."""
    from epipole.flows.command_line.log_info import describe, lines
    from epipole.io.logs.listing import list_logs

    described = [describe(log) for where in logs for log in list_logs(where)[0]]
    if as_json:
        _print_json(described)
    else:
        _print_lines(line for log in described for line in lines(log))


@app.command()
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
        _print_json([as_dict(report) for report in reports])
    else:
        _print_lines(line for report in reports for line in lines(report))
    if not any(report.camera for report in reports):
        sys.exit(1)


@app.command()
def simulate(
    scene: Annotated[
        str, typer.Argument(metavar="SCENE", help="Name of a built-in scene, or a TOML file.")
    ],
    out: Annotated[
        Path, typer.Option(metavar="LOG", help="Log to write. Its truth goes to LOG.truth.")
    ],
    seed: Annotated[
        int | None,
        typer.Option(
            min=0, metavar="N", help="Seed of the random numbers, instead of the scene's."
        ),
    ] = None,
    sensors: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Number of sensors in the first group.")
    ] = None,
    objects: Annotated[
        int | None, typer.Option(min=0, metavar="N", help="Number of objects in the first group.")
    ] = None,
    hours: Annotated[
        float | None, typer.Option(metavar="H", help="Duration in hours, instead of the scene's.")
    ] = None,
    rate_hz: Annotated[
        float | None,
        typer.Option("--rate", metavar="HZ", help="Frames per second of every sensor."),
    ] = None,
    start: Annotated[
        str | None, typer.Option(metavar="TIME", help="Start in UTC, such as 2019-04-01T04:00:00Z.")
    ] = None,
    logs: Annotated[
        int, typer.Option(min=1, metavar="N", help="Write N logs, one after the other in time.")
    ] = 1,
    encoding: Annotated[Encoding, typer.Option(help="Encoding of the messages.")] = Encoding[
        "protobuf"
    ],
    compression: Annotated[
        Compression, typer.Option(help="Compression of the chunks.")
    ] = Compression.zstd,
    as_json: AsJson = False,
) -> None:
    """Simulate a scene: write a log, and its truth beside it.

    Built-in scenes:

    four_sensor_geo: four sensors in low orbits, nine geostationary objects, one minute

    six_sensor_wide: wide fields, no prior attitudes, many false points

    lost_in_space: a new attitude in every frame

    night: any number of sensors, objects and hours

    real_geo: real satellites, low ones that look at geostationary ones, some co-located

    real_leo: real satellites, low ones in wide fields above the pole

    A scene's orbits may come from files of element sets (two-line elements, or OMM in
    JSON, CSV or XML): docs/scenes.md.
    """
    from epipole.flows.night.summary import many
    from epipole.flows.simulate import simulate

    made = simulate(
        scene,
        out,
        seed=seed,
        sensors=sensors,
        objects=objects,
        hours=hours,
        rate_hz=rate_hz,
        start=_instant(start),
        logs=logs,
        encoding=encoding.value,
        compression=compression.value,
    )
    if as_json:
        _print_json(vars(made) | {"logs": [str(p) for p in made.logs], "truth": str(made.truth)})
        return
    counts = (
        f"{many(made.sensors, 'sensor')}, {many(made.objects, 'object')}, "
        f"{many(made.frames, 'frame')}, {many(made.centroids, 'centroid')}"
    )
    logs_made = ", ".join(str(log) for log in made.logs)
    _print_lines([f"log    {logs_made}", f"truth  {made.truth}", counts])


@app.command()
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
        _print_json(report.as_dict())
    else:
        show(report)


@app.command()
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

    _check_night(night)
    files = export(message, dataset, night, out, object_ids or ())
    if as_json:
        _print_json({"folder": str(out), "files": files})
    else:
        _print_lines([f"folder  {out}", f"files   {len(files)}: {files[0]} to {files[-1]}"])


def _instant(text: str | None) -> datetime.datetime | None:
    """Return an aware time. A time without a zone is UTC."""
    if text is None:
        return None
    try:
        instant = datetime.datetime.fromisoformat(text)
    except ValueError:
        raise typer.BadParameter(
            f"{text!r} is not a time such as 2019-04-01T04:00:00Z", param_hint="--start"
        ) from None
    return instant if instant.tzinfo else instant.replace(tzinfo=datetime.UTC)


@app.command()
def settings() -> None:
    """Print all settings with their defaults, as TOML for `epipole run --settings`."""
    from epipole.io.settings_file import settings_text
    from epipole.schemas.settings import Settings

    typer.echo(settings_text(Settings()), nl=False)


catalog = typer.Typer(help="Build a star catalogue for star identification.", no_args_is_help=True)
app.add_typer(catalog, name="catalog")


@catalog.callback()
def _catalog() -> None:
    """Make `build` a subcommand, though it is the only one."""


@catalog.command()
def build(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE", help="hipparcos, deep, or a CSV or Parquet file of stars."
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

    hipparcos: what a run uses by default, complete to magnitude 7.3

    deep: Gaia DR3 to G 10 with the motions of Hipparcos, for fields below 5 degrees.
    Needs the extra "deep" of epipole. Its data are share-alike (CC BY-SA 3.0).

    A file needs the columns star_id (whole numbers), ra_deg, dec_deg (ICRS) and
    magnitude (V). It may have pm_ra_mas_yr (times cos dec), pm_dec_mas_yr,
    parallax_mas, sigma_mas, pm_sigma_mas_yr (1-sigma per axis) and variable
    (true or false). Invalid rows are reported by number, from 1 without the header.
    """
    from epipole.flows.catalogue import build_catalogue

    built = build_catalogue(source, out, epoch, name, magnitude_limit)
    if as_json:
        _print_json(built.as_dict())
    else:
        _print_lines(built.lines())


def _print_lines(lines: Iterable[str]) -> None:
    """Print lines that may have names from a log in them."""
    for line in lines:
        typer.echo(as_line(line))


def _print_json(value: Any) -> None:
    typer.echo(json.dumps(value, indent=2))

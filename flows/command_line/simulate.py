"""`epipole simulate`: a log with its truth."""

import datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from epipole.flows.command_line.options import AsJson, print_json, print_lines
from epipole.io.logs.messages.registry import ENCODINGS

# How the messages of a log are encoded.
Encoding = StrEnum("Encoding", {name: name for name in ENCODINGS})  # type: ignore[misc]


class Compression(StrEnum):
    """How the chunks of a log are compressed."""

    zstd = "zstd"
    lz4 = "lz4"
    none = "none"


def simulate(
    scene: Annotated[
        str, typer.Argument(metavar="SCENE", help="Name of a built-in scene, or a TOML file.")
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="LOG",
            help="Log to write. Its truth goes to LOG.truth. For a constellation, a name without "
            ".mcap is a folder, with a log for each satellite.",
        ),
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
    satellites: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="constellation: number of satellites with sensors."),
    ] = None,
    near: Annotated[
        bool, typer.Option("--near", help="constellation: satellites that are near each other.")
    ] = False,
    elements: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Element sets (TLE or OMM): real objects instead of those of the first group.",
        ),
    ] = None,
    hours: Annotated[
        float | None, typer.Option(metavar="H", help="Duration in hours, instead of the scene's.")
    ] = None,
    seconds: Annotated[
        float | None, typer.Option(metavar="S", help="Duration in seconds instead.")
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

    constellation: satellites with two trackers each, fixed to the body, that see what passes

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
        satellites=satellites,
        near=near,
        elements=elements,
        hours=hours,
        seconds=seconds,
        rate_hz=rate_hz,
        start=_instant(start),
        logs=logs,
        encoding=encoding.value,
        compression=compression.value,
    )
    if as_json:
        print_json(vars(made) | {"logs": [str(p) for p in made.logs], "truth": str(made.truth)})
        return
    counts = (
        f"{many(made.sensors, 'sensor')}, {many(made.objects, 'object')}, "
        f"{many(made.frames, 'frame')}, {many(made.centroids, 'centroid')}"
    )
    logs_made = ", ".join(str(log) for log in made.logs)
    if len(made.logs) > 1 and out.is_dir():
        logs_made = f"{out} ({many(len(made.logs), 'log')})"
    print_lines([f"log    {logs_made}", f"truth  {made.truth}", counts])


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

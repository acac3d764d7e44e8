"""What Orekit reads in exported messages of orbits: states and covariances.

As a process: `scenes.orekit_reads FOLDER...` prints the table as JSON.
"""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import polars as pl

from epipole.schemas.columns import POSITION, VELOCITY
from scenes.orekit_process import printed_by, started_example

STATE = (*POSITION, *VELOCITY)


def orekit_reads(*folders: Path) -> pl.DataFrame:
    """Return a row per state of the OEMs, OPMs and OCMs in some folders, as Orekit reads it.

    Returns
    -------
    DataFrame
        `folder`, `file`, `time` (UTC, text), `frame` (Orekit's name), the state as it is written
        [km, km/s], `gcrf_x_km` to `gcrf_z_km`: its place in GCRF by Orekit's rotation of the Earth,
        `cov`: the covariance's lower triangle, row by row [km, s].
    """
    return printed_by("orekit_reads", *folders)


def main(*folders: Path) -> None:
    """Print the table of `orekit_reads`."""
    example = started_example()
    rows = [
        {"folder": folder.name, "file": path.name} | row_of(example, *read)
        for folder in folders
        for path in sorted(folder.iterdir())
        for read in READERS[path.suffix](example, example.DataSource(example.File(str(path))))
    ]
    print(pl.DataFrame(rows, infer_schema_length=None).write_json())


def parsers(example: SimpleNamespace) -> Any:
    """Return Orekit's builder of parsers, with the tides in the Earth's rotation."""
    return example.ParserBuilder().withSimpleEOP(False).withMu(example.GM)


def of_oem(example: SimpleNamespace, source: Any) -> Iterator[tuple[Any, Any, Any]]:
    """Yield state, frame and covariance of an OEM."""
    (satellite,) = parsers(example).buildOemParser().parseMessage(source).getSatellites().values()
    (segment,) = satellite.getSegments()
    matrices = [each.getCovarianceMatrix() for each in segment.getCovarianceMatrices()]
    for state, matrix in zip(segment.getCoordinates(), matrices, strict=True):
        yield state, segment.getFrame(), matrix


def of_opm(example: SimpleNamespace, source: Any) -> Iterator[tuple[Any, Any, Any]]:
    """Yield state, frame and covariance of an OPM."""
    message = parsers(example).buildOpmParser().parseMessage(source)
    matrix = message.getData().getCovarianceBlock().getCovarianceMatrix()
    yield message.getPVCoordinates(), message.getMetadata().getFrame(), matrix


def of_ocm(example: SimpleNamespace, source: Any) -> Iterator[tuple[Any, Any, Any]]:
    """Yield state, frame and covariance of an OCM."""
    data = parsers(example).buildOcmParser().parseMessage(source).getSegments().get(0).getData()
    (trajectory,), (covariance,) = data.getTrajectoryBlocks(), data.getCovarianceBlocks()
    matrices = [each.getMatrix() for each in covariance.getCovariances()]
    for state, matrix in zip(trajectory.getCoordinates(), matrices, strict=True):
        yield state, trajectory.getFrame(), matrix


READERS = {".oem": of_oem, ".opm": of_opm, ".ocm": of_ocm}


def row_of(example: SimpleNamespace, state: Any, frame: Any, matrix: Any) -> dict[str, Any]:
    """Return a state as a row."""
    values = [*state.getPosition().toArray(), *state.getVelocity().toArray()]
    gcrf = example.FramesFactory.getGCRF()
    there = frame.getTransformTo(gcrf, state.getDate()).transformPosition(state.getPosition())
    row = {"time": str(state.getDate().toString()).rstrip("Z"), "frame": str(frame.getName())}
    row |= dict(zip(STATE, (value / 1e3 for value in values), strict=True))
    row |= {
        f"gcrf_{axis}_km": value / 1e3 for axis, value in zip("xyz", there.toArray(), strict=True)
    }
    return row | {"cov": [matrix.getEntry(i, j) / 1e6 for i in range(6) for j in range(i + 1)]}


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))

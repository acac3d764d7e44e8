"""Export a night's objects as messages for orbit determination: CCSDS TDM, OEM and OPM."""

import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import polars as pl

from epipole.io.ccsds import (
    ephemeris_message,
    safe_name,
    state_message,
    tracking_data,
    write_message,
)
from epipole.io.datasets.dataset import nights_in, read_table
from epipole.io.paths import fault_of_name
from epipole.schemas.bridge import to_polars
from epipole.schemas.errors import DatasetError
from epipole.schemas.options import Message
from epipole.tasks.export import arcs, directions, sensor_ephemeris, single_states

OF_STATE = "State of an object, fitted to its lines of sight; covariance in the same frame."
OF_ARC = "A fitted state, moved through its arc: point mass and J2; not to be extrapolated."
OF_SENSOR = "The sensor's positions and velocities at its frames, from its log."


def export(
    kind: Message, dataset: str, night: str, out: Path, object_ids: Sequence[str] = ()
) -> list[str]:
    """Write messages of the objects of a night into an empty folder, all of them or none.

    Returns
    -------
    list of str
        The names of the files: of TDMs one per object and an ephemeris per sensor, of OEMs one
        per object, of OPMs one per state.

    Raises
    ------
    DatasetError
        Where the night or an object does not exist, or the folder is not empty.
    """
    _check_out(out)
    if night not in nights_in(dataset):
        raise DatasetError(f"{dataset}: has no night {night}")
    tables = _NightTables(dataset, night)
    with tempfile.TemporaryDirectory(prefix=".export-", dir=_parent(out)) as made:
        if kind == Message.tdm:
            _write_tracking_data(tables, object_ids, Path(made))
        else:
            _write_states(kind, tables, object_ids, Path(made))
        files = sorted(path.name for path in Path(made).iterdir())
        if not files:
            raise DatasetError(f"{dataset}: the night {night} has no {kind.table} to export")
        out.mkdir(exist_ok=True)
        for name in files:
            shutil.move(Path(made) / name, out / name)
    return files


class _NightTables:
    """The tables of a night."""

    def __init__(self, dataset: str, night: str) -> None:
        self.dataset, self.night = dataset, night

    def read(self, table: str) -> pl.DataFrame:
        return to_polars(read_table(self.dataset, table, self.night))

    def by_object(self, table: str, wanted: Sequence[str]) -> dict[str, pl.DataFrame]:
        """Return the rows of each object, of these or of all."""
        rows = self.read(table)
        found = rows.drop_nulls("object_id").partition_by("object_id", as_dict=True)
        by_id = {str(key): of_object for (key,), of_object in sorted(found.items())}
        missing = [name for name in wanted if name not in by_id]
        if missing:
            raise DatasetError(
                f"{self.dataset}: the night {self.night} has no {table} of {', '.join(missing)}"
            )
        return {name: by_id[name] for name in wanted or by_id}


def _write_tracking_data(night: _NightTables, wanted: Sequence[str], folder: Path) -> None:
    objects = night.by_object("observations", wanted)
    sensors = {name for rows in objects.values() for name in rows["sensor_id"].unique()}
    ephemerides = _file_names(sorted(sensors), "oem")
    frames = night.read("frames")
    for sensor, file in ephemerides.items():
        of_sensor = sensor_ephemeris(frames.filter(pl.col("sensor_id") == sensor))
        write_message(folder / file, ephemeris_message(sensor, [of_sensor], [OF_SENSOR]))
    for name, file in _file_names(list(objects), "tdm").items():
        write_message(folder / file, tracking_data(name, directions(objects[name], ephemerides)))


def _write_states(kind: Message, night: _NightTables, wanted: Sequence[str], folder: Path) -> None:
    objects = night.by_object("states", wanted)
    positions = night.read("positions") if kind == Message.oem else None
    for name, file in _file_names(list(objects), kind.value).items():
        states, path = objects[name], folder / file
        if positions is not None:
            of_object = positions.filter(pl.col("object_id") == name)
            write_message(path, ephemeris_message(name, arcs(states, of_object), [OF_ARC]))
            continue
        for number, state in enumerate(single_states(states.sort("epoch")), 1):
            numbered = path.with_name(f"{path.stem}-{number}{path.suffix}")
            write_message(numbered, state_message(name, state, [OF_STATE]))


def _file_names(names: Sequence[str], ending: str) -> Mapping[str, str]:
    """Return a file name for each name; those that would be the same get a number."""
    taken: dict[str, str] = {}
    for name in names:
        file, number = f"{safe_name(name)}.{ending}", 2
        while file in taken.values():
            file, number = f"{safe_name(name)}-{number}.{ending}", number + 1
        taken[name] = file
    return taken


def _check_out(out: Path) -> None:
    if (fault := fault_of_name(str(out) if out != Path() else "")) is not None:
        raise DatasetError(f"{out}: {fault}")
    if out.exists() and not out.is_dir():
        raise DatasetError(f"{out}: is a file, not a folder; give another folder")
    if out.is_dir() and any(out.iterdir()):
        raise DatasetError(f"{out}: is not empty; give a new or an empty folder")


def _parent(out: Path) -> Path:
    """Return the folder in which `out` lies; it is made."""
    parent = out.resolve().parent
    try:
        parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DatasetError(f"{out}: cannot be made ({error.strerror})") from error
    return parent

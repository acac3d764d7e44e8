"""Export a night's objects as messages: CCSDS TDM, OEM, OPM and OCM; observations as ADES."""

import shutil
import tempfile
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import polars as pl

from epipole.io.ades import catalogue_name, observation_file
from epipole.io.ccsds import (
    Directions,
    Ephemeris,
    Subject,
    comprehensive_message,
    ephemeris_message,
    safe_name,
    state_message,
    tracking_data,
    write_message,
)
from epipole.io.datasets.dataset import night_row, nights_in, read_table
from epipole.io.paths import fault_of_name
from epipole.schemas.bridge import to_polars
from epipole.schemas.errors import DatasetError
from epipole.schemas.options import Message, MessageForm, MessageFrame, star_ids_of
from epipole.schemas.rejects import ObjectVerdict
from epipole.tasks.algorithms.constants import SECOND_NS
from epipole.tasks.common.orbit_forces import noon_ns, surroundings_of
from epipole.tasks.export import (
    arcs,
    directions,
    in_frame,
    orbit_arc,
    sensor_ephemeris,
    single_orbit,
    single_states,
    subjects,
)

HOUR_NS = 3_600_000_000_000

OF_STATE = "State of an object, fitted to its lines of sight; covariance in the same frame."
OF_ARC = "A fitted state, moved through its arc: point mass and J2; not to be extrapolated."
OF_ORBIT = "Orbit fitted to the observations of the night; covariance in the same frame."
OF_FORCES = "Forces of the fit, by which it is moved:"
OF_AHEAD = "It goes on after its arc: errors of the forces are not in the covariance."
OF_FALL = "The object comes down: its ephemeris ends there."
OF_SENSOR = "The sensor's positions and velocities at its frames, from its log."
# Verdicts that a message has to say.
DOUBTS = {
    verdict.value: verdict.sentence
    for verdict in ObjectVerdict
    if verdict not in (ObjectVerdict.SOUND, ObjectVerdict.NO_ORBIT)
}


class Wanted(NamedTuple):
    """What is asked for of a night; no ids: all objects.

    `ahead_h` hours after its arc an orbit goes on, in an OEM or OCM.
    """

    object_ids: Sequence[str] = ()
    frame: MessageFrame = MessageFrame.GCRF
    ahead_h: float = 0.0
    form: MessageForm = MessageForm.kvn


ALL = Wanted()


def export(kind: Message, dataset: str, night: str, out: Path, wanted: Wanted = ALL) -> list[str]:
    """Write messages of the objects of a night into an empty folder, all of them or none.

    Returns
    -------
    list of str
        The names of the files: of TDMs one per object, one per sensor with its tracklets that
        belong to none, and an ephemeris per sensor; of OEMs one per object; of OPMs and OCMs one
        per orbit, or per state of an object without orbit; of ADES one for all.

    Raises
    ------
    DatasetError
        Where the night or an object does not exist, the folder is not empty, or it cannot be made.
    """
    asked = wanted._replace(object_ids=list(dict.fromkeys(wanted.object_ids)))
    try:
        return _exported(kind, dataset, night, out, asked)
    except OSError as error:
        raise DatasetError(f"{out}: cannot be made ({error.strerror or error})") from error


def _exported(kind: Message, dataset: str, night: str, out: Path, wanted: Wanted) -> list[str]:
    """Do as `export` says; no id is asked for twice."""
    _check_out(out)
    if night not in nights_in(dataset):
        raise DatasetError(f"{dataset}: has no night {night}")
    tables = _NightTables(dataset, night)
    with tempfile.TemporaryDirectory(prefix=".export-", dir=_parent(out)) as made:
        if kind == Message.tdm:
            _write_tracking_data(tables, wanted, Path(made))
        elif kind == Message.ades:
            _write_observations(tables, wanted.object_ids, Path(made))
        else:
            _write_states(kind, tables, wanted, Path(made))
        files = sorted(path.name for path in Path(made).iterdir())
        if not files:
            raise DatasetError(f"{dataset}: the night {night} has no {kind.table} to export")
        out.mkdir(exist_ok=True)
        for name in files:
            shutil.move(Path(made) / name, out / name)
    return files


class _NightTables:
    """The tables of a night; `subjects` are the objects and tracklets that have a name."""

    def __init__(self, dataset: str, night: str) -> None:
        self.dataset, self.night = dataset, night
        self.subjects = subjects(self.read("identifications"))
        self.verdicts = dict(self.read("objects").select("object_id", "verdict").iter_rows())

    def read(self, table: str) -> pl.DataFrame:
        return to_polars(read_table(self.dataset, table, self.night))

    def subject(self, name: str) -> Subject:
        """Return an object or a tracklet with what is known of it."""
        return self.subjects.get(name, Subject(name))

    def doubts(self, name: str) -> list[str]:
        """Return a comment with what is known against an object, or against a single orbit."""
        verdict = self.verdicts.get(name)
        return [f"Verdict {verdict}: {DOUBTS[verdict]}"] if verdict in DOUBTS else []

    def by_id(self, rows: pl.DataFrame, key: str) -> dict[str, pl.DataFrame]:
        """Return the rows of each object or tracklet, in the order of the ids."""
        found = rows.drop_nulls(key).partition_by(key, as_dict=True)
        return {str(name): of_one for (name,), of_one in sorted(found.items())}

    def check(self, what: str, wanted: Sequence[str], found: Collection[str]) -> None:
        """Raise where an id that is asked for is missing."""
        if missing := [name for name in wanted if name not in found]:
            raise DatasetError(
                f"{self.dataset}: the night {self.night} has no {what} of {', '.join(missing)}"
            )


ByName = dict[str, pl.DataFrame]


def _observed(night: _NightTables, wanted: Sequence[str]) -> tuple[ByName, ByName]:
    """Return OBSERVATIONS of each object, and of each tracklet without; of those asked for."""
    rows = night.read("observations")
    objects = night.by_id(rows, "object_id")
    # Rows of an object's tracklet that do not show it are left out.
    of_none = pl.col("object_id").is_null().all().over("tracklet_id")
    tracklets = night.by_id(rows.filter(of_none), "tracklet_id")
    night.check(Message.tdm.table, wanted, {*objects, *tracklets})
    if wanted:
        objects, tracklets = (
            {name: of[name] for name in wanted if name in of} for of in (objects, tracklets)
        )
    return objects, tracklets


def _write_observations(night: _NightTables, wanted: Sequence[str], folder: Path) -> None:
    """Write the observations of all objects and tracklets, in order of time."""
    objects, tracklets = _observed(night, wanted)
    found = [*objects.values(), *tracklets.values()]
    if found:
        ids = star_ids_of(night_row(night.dataset, night.night))
        rows = pl.concat(found).sort("time", "sensor_id", "tracklet_id")
        text = observation_file(rows, night.subjects, catalogue_name(ids))
        write_message(folder / f"{night.night}.psv", text)


def _write_tracking_data(night: _NightTables, wanted: Wanted, folder: Path) -> None:
    objects, tracklets = _observed(night, wanted.object_ids)
    sensors = {name for of in (*objects.values(), *tracklets.values()) for name in of["sensor_id"]}
    called, ending = _message_names(sorted(sensors)), _ending("oem", wanted.form)
    ephemerides = {sensor: f"{name}.{ending}" for sensor, name in called.items()}
    frames = night.read("frames")
    for sensor, file in ephemerides.items():
        of_sensor = sensor_ephemeris(frames.filter(pl.col("sensor_id") == sensor))
        subject = Subject(called[sensor])
        text = ephemeris_message(subject, [of_sensor], [OF_SENSOR], wanted.form)
        write_message(folder / file, text)
    segments: dict[str, list[tuple[Subject, str, Directions]]] = {}
    for name, of in (*objects.items(), *tracklets.items()):
        for sensor, seen in directions(of, ephemerides).items():
            group = name if name in objects else sensor  # a sensor's tracklets are one message
            segment = night.subject(name), called[sensor], seen
            segments.setdefault(group, []).append(segment)
    ending = _ending("tdm", wanted.form)
    for group, name in _message_names(list(segments)).items():
        write_message(folder / f"{name}.{ending}", tracking_data(segments[group], wanted.form))


def _write_states(kind: Message, night: _NightTables, wanted: Wanted, folder: Path) -> None:
    """Write the orbit of each object; without one, its states."""
    rows = night.read("orbits").with_columns(epoch_ns=pl.col("epoch").dt.epoch("ns"))
    orbits = {row["object_id"]: row for row in rows.drop("epoch").iter_rows(named=True)}
    states = night.by_id(night.read("states"), "object_id")
    night.check(kind.table, wanted.object_ids, {*orbits, *states})
    names = wanted.object_ids or sorted({*orbits, *states})
    moved = kind != Message.opm
    around = surroundings_of(night.night, round(wanted.ahead_h * HOUR_NS))
    origin_ns = noon_ns(night.night)
    rows = night.read("positions") if moved else pl.DataFrame({"object_id": []})
    positions = night.by_id(rows, "object_id")
    ending = _ending(kind.value, wanted.form)
    for name, stem in _message_names(names).items():
        orbit = orbits.get(name)
        if orbit is not None:
            comments, ahead_s = [OF_ORBIT, OF_FORCES, orbit["forces"]], wanted.ahead_h * 3600
            parts = [orbit_arc(orbit, around, origin_ns, ahead_s) if moved else single_orbit(orbit)]
            comments += _of_ahead(orbit, parts[0], ahead_s) if moved else []
        elif moved:
            comments = [OF_ARC]
            parts = arcs(states[name], positions.get(name, rows.clear()))
        else:
            comments, parts = [OF_STATE], single_states(states[name].sort("epoch"))
        parts = [in_frame(part, wanted.frame.value) for part in parts]
        _write_parts(
            kind, folder / f"{stem}.{ending}", night.subject(name), parts,
            [*comments, *night.doubts(name)], wanted.form,
        )  # fmt: skip


def _of_ahead(orbit: Mapping[str, Any], arc: Ephemeris, ahead_s: float) -> list[str]:
    """Return what is to be said of the time after an orbit's arc."""
    lasts_s = (int(arc.time_ns[-1]) - orbit["epoch_ns"]) / SECOND_NS
    comes_down = lasts_s < orbit["arc_s"] / 2 + ahead_s - 1.0
    return [OF_AHEAD] * bool(ahead_s) + [OF_FALL] * comes_down


def _write_parts(
    kind: Message, path: Path, of: Subject, parts: Sequence[Ephemeris], comments: Sequence[str],
    form: MessageForm,
) -> None:  # fmt: skip
    """Write an OEM of all parts, or a numbered OPM or OCM of each."""
    if kind == Message.oem:
        write_message(path, ephemeris_message(of, parts, comments, form))
        return
    message = state_message if kind == Message.opm else comprehensive_message
    for number, part in enumerate(parts, 1):
        stem, _, ending = path.name.rpartition(f".{kind.value}")
        numbered = path.with_name(f"{stem}-{number}.{kind.value}{ending}")
        write_message(numbered, message(of, part, comments, form))


def _ending(kind: str, form: MessageForm) -> str:
    return kind if form == MessageForm.kvn else f"{kind}.{form.value}"


def _message_names(names: Sequence[str]) -> Mapping[str, str]:
    """Return each one's name in messages and of its files; those that would be one get a number."""
    found: dict[str, str] = {}
    taken: set[str] = set()
    for name in names:
        free, number = safe_name(name), 2
        while free in taken:
            free, number = f"{safe_name(name)}-{number}", number + 1
        found[name] = free
        taken.add(free)
    return found


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
    parent.mkdir(parents=True, exist_ok=True)
    return parent

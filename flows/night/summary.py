"""The summary of a run: counts of what it found, and of what it left out by reason."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.datasets.night_tables import Where, count_rows, read_columns
from epipole.schemas.bridge import to_polars
from epipole.schemas.log_checks import MISTAKE_COLUMNS, mistakes
from epipole.schemas.rejects import NameStatus, ObjectVerdict, Outcome, Reason, by_reason
from epipole.schemas.stages import Declared
from epipole.tasks.report.night_facts import ReportExtract

LISTED = 4  # sentences in a run's state; the others are on its page


@dataclass(frozen=True)
class SensorSummary:
    """Counts of one sensor.

    The residual is the median of its frames, the gap the longest time between frames that were
    identified; None without stars.
    """

    sensor_id: str
    frames: int
    identified: int
    residual_px: float | None
    gap_s: float | None
    tracks: int

    def as_row(self) -> dict[str, Any]:
        """Return the counts as a row of a table that people read."""
        residual = "" if self.residual_px is None else f"{self.residual_px:.3f}"
        gap = "" if self.gap_s is None else f"{self.gap_s:,.0f}"
        return {
            "sensor": self.sensor_id,
            "frames": self.frames,
            "identified": self.identified,
            "identified %": f"{100 * self.identified / self.frames:.1f}",
            "longest gap s": gap,
            "residual px": residual,
            "tracks": self.tracks,
        }


@dataclass(frozen=True)
class Summary:
    """Counts of what was published.

    `outcomes` are the tracklets by what became of them, `verdicts` the objects. `names` are the
    objects by what is known of their names, `tracklet_names` the tracklets that belong to none;
    both are empty without a catalogue. `mistakes` in logs, `faults` of sensors and
    `residuals` of their known objects are a sentence each. `unchanged` nights were not made again.
    """

    dataset: str
    nights: list[str]
    logs: int
    sensors: int
    frames: int
    identified: int
    stars: int
    detections: int
    tracklets: int
    outcomes: dict[str, int]
    epochs: int
    objects: int
    verdicts: dict[str, int]
    positions: int
    names: dict[str, int]
    tracklet_names: dict[str, int]
    rejects: dict[str, int]
    mistakes: list[str]
    faults: list[str]
    residuals: list[str]
    unchanged: bool
    by_sensor: list[SensorSummary]
    extracts: tuple[ReportExtract, ...]  # of the nights' reports, for Prefect's page
    looks: Mapping[str, Sequence[str]] = field(default_factory=dict)  # by night: needs a look
    earlier: tuple[str, ...] = ()  # what became of nights before these that were made too

    def as_dict(self) -> dict[str, Any]:
        """Return the counts by name, as JSON takes them."""
        counts = asdict(replace(self, extracts=()))
        del counts["extracts"]
        return counts

    def lines(self) -> list[str]:
        """Return the summary as people read it."""
        return [
            f"nights      {', '.join(self.nights)}"
            + (", unchanged: not made again (--again makes them)" if self.unchanged else ""),
            f"frames      {self.frames:,} of {many(self.sensors, 'sensor')} "
            f"in {many(self.logs, 'log')}",
            f"identified  {self.identified:,} by {self.stars:,} stars",
            f"objects     {self.objects:,} in {self.detections:,} detections, "
            f"{many(self.tracklets, 'tracklet')}",
            *([f"  not sound {_listed(doubtful)}"] if (doubtful := self.doubtful()) else []),
            *self._without_object(),
            f"positions   {self.positions:,} at {many(self.epochs, 'epoch')}",
            *self._names(),
            *[f"mistake     {mistake}" for mistake in self.mistakes],
            *[f"fault       {fault}" for fault in self.faults],
            *[f"look        {each}" for each in self.needs_look() if each not in self.mistakes],
            *self._left_out(),
            f"dataset     {self.dataset}",
        ]

    def sentence(self) -> str:
        """Return what was found as one line, with what needs a look."""
        looks = self.needs_look()
        more = [f"and {len(looks) - LISTED} more"] if len(looks) > LISTED else []
        sentences = [f"needs a look: {'; '.join([*looks[:LISTED], *more])}"] if looks else []
        sentences += self.earlier
        if self.unchanged:
            return "; ".join([f"unchanged: {', '.join(self.nights)}", *sentences])
        parts = [
            many(self.objects, "object"),
            many(self.positions, "position"),
            f"{self.identified:,} of {many(self.frames, 'frame')} identified",
        ]
        if self.rejects:
            parts.append(f"{sum(self.rejects.values()):,} left out")
        return "; ".join([", ".join(parts), *sentences])

    def needs_look(self) -> list[str]:
        """Return what needs a look, a sentence each."""
        return _by_night({night: self.looks.get(night, ()) for night in self.nights})

    def doubtful(self) -> dict[str, int]:
        """Return how many objects are not sound, by verdict."""
        return {name: n for name, n in self.verdicts.items() if name != ObjectVerdict.SOUND}

    def _without_object(self) -> list[str]:
        """Return how many tracklets orbits joined, and how many have no object, by outcome."""
        joined = {Outcome.OBJECT, Outcome.LINKED}
        alone = {name: n for name, n in self.outcomes.items() if name not in joined}
        linked = self.outcomes.get(Outcome.LINKED, 0)
        lines = [f"  linked    {many(linked, 'tracklet')} by orbits"] if linked else []
        if not alone:
            return lines
        return [*lines, f"  without   {many(sum(alone.values()), 'tracklet')}: {_listed(alone)}"]

    def _names(self) -> list[str]:
        """Return what is known of names, and of the sensors by known objects."""
        lines: list[str] = []
        for counts, of in ((self.names, "object"), (self.tracklet_names, "tracklet")):
            if counts:
                heading = "names" if not lines else ""
                lines.append(f"{heading:<12}{many(sum(counts.values()), of)}: {_listed(counts)}")
        return lines + [f"  {residual}" for residual in self.residuals]

    def _left_out(self) -> list[str]:
        """Return what was left out, by reason; nothing where nothing was."""
        if not self.rejects:
            return []
        width = max(len(f"{count:,}") for count in self.rejects.values())
        lines = [
            f"  {count:>{width},} {reason}: {Reason(reason).sentence}"
            for reason, count in self.rejects.items()
        ]
        return [f"left out    {sum(self.rejects.values()):,}:", *lines]


def _listed(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count:,} {name}" for name, count in counts.items())


# The columns that are counted: all columns of a whole night would not fit in memory.
_COLUMNS = {
    "frames": ["sensor_id", "time", "attitude_source", "n_stars", "residual_px"],
    "tracklets": ["sensor_id", "track_id", "outcome"],
    "epochs": ["epoch"],
    "objects": ["object_id", "verdict"],
    "sources": ["sha256"],
    "identifications": ["object_id", "status", "catalogue"],
    "rejects": ["reason", "count"],
}


def count(folders: Sequence[Where]) -> dict[str, int]:
    """Return the counts of nights together, as the table `nights` has them of one night."""
    return _count(folders, _tables(folders))


def _count(folders: Sequence[Where], tables: Mapping[str, pa.Table]) -> dict[str, int]:
    """Do as `count` says, with what `_tables` returns."""
    frames = tables["frames"]
    return {
        "logs": pc.count_distinct(tables["sources"]["sha256"]).as_py(),
        "sensors": pc.count_distinct(frames["sensor_id"]).as_py(),
        "frames": frames.num_rows,
        "identified": pc.sum(pc.equal(frames["attitude_source"], "stars")).as_py() or 0,
        "stars": pc.sum(frames["n_stars"]).as_py() or 0,  # those left out of `stars` too
        "detections": sum(count_rows(folder, "detections") for folder in folders),
        "tracklets": tables["tracklets"].num_rows,
        "epochs": pc.count_distinct(tables["epochs"]["epoch"]).as_py(),
        "objects": pc.count_distinct(tables["objects"]["object_id"]).as_py(),
        "positions": sum(count_rows(folder, "positions") for folder in folders),
        "left_out": pc.sum(tables["rejects"]["count"]).as_py() or 0,
    }


def summarise(dataset: str, nights: Mapping[str, Where], unchanged: bool = False) -> Summary:
    """Return the summary of nights, by the folder or URL of each."""
    folders = list(nights.values())
    tables = _tables(folders)
    counts = _count(folders, tables)
    counts.pop("left_out")  # given by reason
    rows = {
        night: read_columns(folder, "nights", ["faults", "residuals"]).to_pylist()[0]
        for night, folder in nights.items()
    }
    return Summary(
        dataset=dataset,
        nights=list(nights),
        **counts,
        outcomes=_counted(tables["tracklets"]["outcome"], Outcome),
        verdicts=_counted(tables["objects"]["verdict"], ObjectVerdict),
        names=_names(tables["identifications"], pc.is_valid),
        tracklet_names=_names(tables["identifications"], pc.is_null),
        rejects=by_reason(tables["rejects"]),
        mistakes=_by_night(
            {
                night: mistakes(read_columns(folder, "checks", MISTAKE_COLUMNS).to_pylist())
                for night, folder in nights.items()
            }
        ),
        faults=_by_night({night: row["faults"] for night, row in rows.items()}),
        residuals=_by_night({night: row["residuals"] for night, row in rows.items()}),
        unchanged=unchanged,
        by_sensor=_by_sensor(to_polars(tables["frames"]), to_polars(tables["tracklets"])),
        extracts=(),
        looks={},
        earlier=(),
    )


def _tables(folders: Sequence[Where]) -> dict[str, pa.Table]:
    return {
        name: pa.concat_tables([read_columns(folder, name, columns) for folder in folders])
        for name, columns in _COLUMNS.items()
    }


def _names(identifications: pa.Table, has_object: Callable[..., Any]) -> dict[str, int]:
    """Return the objects, or the tracklets, by status; empty without a catalogue."""
    rows = identifications.filter(has_object(identifications["object_id"]))
    return _counted(rows.filter(pc.is_valid(rows["catalogue"]))["status"], NameStatus)


def _counted(values: pa.ChunkedArray, declared: type[Declared]) -> dict[str, int]:
    """Return how often each word of a column occurs, in the order in which they are declared."""
    counts = pc.value_counts(values.combine_chunks())
    found = dict(zip(*(c.to_pylist() for c in counts.flatten()), strict=True))
    return {word.value: found[word.value] for word in declared if word.value in found}


def _by_night(sentences: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the sentences of all nights; they name the night where there are several."""
    return [
        f"{night}: {sentence}" if len(sentences) > 1 else sentence
        for night, of_night in sentences.items()
        for sentence in of_night
    ]


def _by_sensor(frames: pl.DataFrame, tracklets: pl.DataFrame) -> list[SensorSummary]:
    """Return the counts of each sensor with frames, in the order of the ids."""
    is_identified = pl.col("attitude_source") == "stars"
    identified_ns = pl.col("time").filter(is_identified).dt.epoch("ns")
    of_frames = frames.group_by("sensor_id").agg(
        frames=pl.len(),
        identified=is_identified.sum(),
        residual_px=pl.col("residual_px").median(),
        gap_s=identified_ns.sort().diff().max() * 1e-9,
    )
    of_tracks = tracklets.group_by("sensor_id").agg(tracks=pl.col("track_id").n_unique())
    rows = of_frames.join(of_tracks, on="sensor_id", how="left").sort("sensor_id")
    rows = rows.with_columns(pl.col("tracks").fill_null(0))
    return [SensorSummary(**row) for row in rows.iter_rows(named=True)]


def many(count: int, what: str) -> str:
    """Return a count with its noun, such as ``1 log`` or ``2,000 logs``."""
    return f"{count:,} {what}" + ("" if count == 1 else "s")

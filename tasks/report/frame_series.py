"""Frames over the night, by sensor: how they got their attitude, how good it is, and gaps."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import polars as pl

from epipole.io.datasets.night_tables import NightReader
from epipole.schemas.arrays import Array, Flags, Indices

# Bins of time: about a hundred per night, however many frames it has.


MAX_BINS = 96
MIN_BINS = 8
FRAMES_IN_BIN = 4  # of the busiest sensor, at least: an empty bin is then a gap


class TimeBins(NamedTuple):
    """Equal bins from the first to the last frame of a night."""

    start_ns: int
    end_ns: int
    number: int

    @property
    def edges_s(self) -> Array:
        """The (number + 1,) edges, in seconds since 0 h of the first day."""
        edges = np.linspace(0.0, (self.end_ns - self.start_ns) / 1e9, self.number + 1)
        return seconds_of_day(np.array([self.start_ns])) + edges

    def of(self, time_ns: Indices) -> Indices:
        """Return the bin of each time; times outside belong to the first or last bin."""
        since = (time_ns - self.start_ns) / max(self.end_ns - self.start_ns, 1)
        return np.clip((since * self.number).astype(np.int64), 0, self.number - 1)


def bins_between(start_ns: int, end_ns: int, frames_of_busiest: int) -> TimeBins:
    """Return bins with a few frames each of the sensor that has most."""
    count = int(np.clip(frames_of_busiest // FRAMES_IN_BIN, MIN_BINS, MAX_BINS))
    return TimeBins(start_ns, end_ns + 1, count)


def seconds_of_day(time_ns: Indices) -> Array:
    """Return the seconds since 0 h UTC of each time's day."""
    seconds: Array = (time_ns % 86_400_000_000_000) / 1e9
    return seconds


def clock(time_ns: int) -> str:
    """Return the time of day, such as ``04:05:06``."""
    return str(np.datetime64(time_ns // 1_000_000_000, "s"))[11:]


# Frames in these bins.


COLUMNS = ["time", "sensor_id", "attitude_source", "status", "n_stars", "n_centroids",
           "sigma_x_arcsec", "sigma_y_arcsec", "sigma_z_arcsec", "residual_px"]  # fmt: skip
FEW_CENTROIDS = 4.0  # in a frame, on average: with fewer, what is sent are no stars
SOURCES = ("stars", "prior", "none")
GAP_FRAMES = 10  # a time without frames that is this many frame intervals long is a gap
SHORTEST_GAP_S = 5.0
MAX_GAPS = 200
# Sums of a bin: squares of sigmas (across, about the boresight) and of the stars' residual.
SUMS = ("across", "about", "residual")


class Gap(NamedTuple):
    """A time in which a sensor has no frames."""

    sensor_id: str
    start_ns: int
    end_ns: int

    @property
    def seconds(self) -> float:
        """Its length."""
        return (self.end_ns - self.start_ns) / 1e9


@dataclass
class FrameSeries:
    """The frames of a night in bins of time.

    counts : (sources, sensors, bins), frames by `SOURCES`
    rms : for each of `SUMS`, (sensors, bins), NaN where no frame has it
    failed : frames by sensor and status
    gaps : the longest ones, of all sensors, in order of time
    lost_s : the length of all gaps, by sensor
    stars : the mean number of stars of an identified frame, by sensor
    centroids : the mean number of centroids of a frame, by sensor
    """

    sensors: list[str]
    bins: TimeBins
    counts: Indices
    rms: dict[str, Array]
    failed: dict[tuple[str, str], int]
    gaps: list[Gap]
    lost_s: Array
    stars: Array
    centroids: Array

    @property
    def frames(self) -> Indices:
        """Frames by sensor."""
        total: Indices = self.counts.sum(axis=(0, 2))
        return total

    @property
    def identified_share(self) -> Array:
        """The share of each sensor's frames that are identified."""
        share: Array = self.counts[0].sum(axis=1) / np.maximum(self.frames, 1)
        return share

    @property
    def sends_no_stars(self) -> Flags:
        """Which sensors send attitudes in place of stars, and hardly a centroid."""
        by_source = self.counts.sum(axis=2)
        return (by_source[1] == self.frames) & (self.centroids < FEW_CENTROIDS)


def read_frame_series(night: NightReader) -> FrameSeries | None:
    """Return the frames of a night; None without frames."""
    ends = night.bounds_ns("frames", "time")
    if ends is None:
        return None
    busiest: dict[str, int] = {}
    for rows in night.pieces("frames", ["sensor_id"]):
        for name, count in rows["sensor_id"].value_counts().iter_rows():
            busiest[name] = busiest.get(name, 0) + count
    sums = _SeriesSums(sorted(busiest), bins_between(*ends, max(busiest.values())))
    for rows in night.pieces("frames", COLUMNS):
        sums.add(rows)
    return sums.result()


class _SeriesSums:
    """The sums over the pieces of the table."""

    def __init__(self, sensors: list[str], bins: TimeBins) -> None:
        shape = (len(sensors), bins.number)
        self.sensors, self.bins = sensors, bins
        self.counts = np.zeros((len(SOURCES), *shape), np.int64)
        self.squares = {name: np.zeros(shape) for name in SUMS}
        self.numbers = {name: np.zeros(shape, np.int64) for name in SUMS}
        self.failed: dict[tuple[str, str], int] = {}
        self.gaps: list[Gap] = []
        self.lost_s = np.zeros(len(sensors))
        self.stars, self.centroids = np.zeros((2, len(sensors)))
        self.last_ns = np.full(len(sensors), -1, np.int64)
        self.interval_ns = np.zeros(len(sensors))

    def add(self, rows: pl.DataFrame) -> None:
        """Add a piece of the table."""
        sensor = codes(rows["sensor_id"], self.sensors)
        source = codes(rows["attitude_source"], list(SOURCES))
        time_ns = rows["time"].dt.epoch("ns").to_numpy()
        bin_ = self.bins.of(time_ns)
        np.add.at(self.counts, (source, sensor, bin_), 1)
        x, y, z, residual = (rows[name].to_numpy() for name in COLUMNS[6:])
        for name, square in (("across", (x * x + y * y) / 2), ("about", z * z),
                             ("residual", residual * residual)):  # fmt: skip
            known = np.isfinite(square)
            np.add.at(self.squares[name], (sensor[known], bin_[known]), square[known])
            np.add.at(self.numbers[name], (sensor[known], bin_[known]), 1)
        self.stars += np.bincount(sensor, rows["n_stars"].to_numpy(), len(self.sensors))
        self.centroids += np.bincount(sensor, rows["n_centroids"].to_numpy(), len(self.sensors))
        failed = rows.filter(pl.col("status").is_not_null()).group_by("sensor_id", "status").len()
        for name, status, count in failed.iter_rows():
            self.failed[name, status] = self.failed.get((name, status), 0) + count
        order = np.argsort(sensor, kind="stable")
        present, first = np.unique(sensor[order], return_index=True)
        parts = np.split(time_ns[order], first[1:])
        for k, of_sensor in zip(present.tolist(), parts, strict=False):
            self._find_gaps(k, of_sensor)

    def _find_gaps(self, k: int, time_ns: Indices, are_frames: bool = True) -> None:
        first = int(self.last_ns[k] < 0)
        before = self.bins.start_ns if first else self.last_ns[k]
        time_ns = np.concatenate([[before], time_ns])
        self.last_ns[k] = time_ns[-1]
        steps = np.diff(time_ns)
        if are_frames and not self.interval_ns[k] and len(inner := steps[first:]):
            self.interval_ns[k] = np.median(inner)
        longest = max(GAP_FRAMES * self.interval_ns[k], SHORTEST_GAP_S * 1e9)
        for i in np.flatnonzero(steps > longest).tolist():
            self.lost_s[k] += steps[i] / 1e9
            self.gaps.append(Gap(self.sensors[k], int(time_ns[i]), int(time_ns[i + 1])))
        if len(self.gaps) > MAX_GAPS:
            self.gaps = sorted(self.gaps, key=lambda gap: -gap.seconds)[:MAX_GAPS]

    def result(self) -> FrameSeries:
        """Return the series; a gap may last to the end of the night."""
        end_ns = np.array([self.bins.end_ns - 1])
        for k in range(len(self.sensors)):
            self._find_gaps(k, end_ns, are_frames=False)
        with np.errstate(invalid="ignore", divide="ignore"):
            rms = {name: np.sqrt(self.squares[name] / self.numbers[name]) for name in SUMS}
            stars = self.stars / self.counts[0].sum(axis=1)
        centroids = self.centroids / np.maximum(self.counts.sum(axis=(0, 2)), 1)
        gaps = sorted(self.gaps, key=lambda gap: (gap.start_ns, gap.sensor_id))
        return FrameSeries(self.sensors, self.bins, self.counts, rms,
                           dict(sorted(self.failed.items())), gaps, self.lost_s, stars,
                           centroids)  # fmt: skip


def codes(names: pl.Series, known: list[str]) -> Indices:
    """Return the index of each name in a list; names that are not in it get its last index."""
    index = names.cast(pl.Enum(known), strict=False).to_physical().fill_null(len(known) - 1)
    return index.to_numpy().astype(np.int64)

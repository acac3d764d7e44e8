"""Stars of a night: residuals against their sigma and over the image, and a map of one frame."""

from typing import Any, NamedTuple

import numpy as np
import polars as pl

from epipole.io.datasets.night_tables import NightReader
from epipole.schemas.arrays import Array, Flags, Indices
from epipole.schemas.log_checks import LogCheck
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.report.frame_series import FrameSeries, codes

# Residuals.


COLUMNS = ["time", "sensor_id", "x_px", "y_px", "dx_px", "dy_px"]
HISTOGRAM = np.linspace(-5.0, 5.0, 51)  # edges, in sigmas
CELLS = 8  # of the image, along each side
SIGMA_BINS = np.geomspace(1e-3, 1e4, 701)  # edges [arcsec]
FITTED = 3  # parameters of an attitude


class StarResiduals(NamedTuple):
    """The residuals of all identified stars, both axes.

    counts : (sensors, bins) of `HISTOGRAM`; without any where no sigma is known
    mean_square : (sensors,), in units of the sigma; NaN where it is not known
    stars : (sensors,) identified stars
    sigma_px : (sensors,) of a centroid, median
    size_px : (sensors, 2) width and height of the image, about
    mean_px : (sensors, cells, cells, 2) mean residual by row and column; NaN without stars
    in_cell : (sensors, cells, cells) stars
    """

    sensors: list[str]
    counts: Indices
    mean_square: Array
    stars: Indices
    sigma_px: Array
    size_px: Array
    mean_px: Array
    in_cell: Indices


def read_star_residuals(
    night: NightReader, sensors: list[str], calibrations: pl.DataFrame
) -> StarResiduals | None:
    """Return the residuals of a night's stars; None: it has no stars.

    Parameters
    ----------
    calibrations
        CALIBRATIONS of the night: the focal lengths turn sigmas to pixels.

    Notes
    -----
    A star has no sigma in the tables. That of the sensor is used: the rms of what the log states
    for its stars (`checks`), else the median of its detections, which are as bright as they happen
    to be. The fit of the attitude takes 3 of the 2 n degrees of freedom of n stars.
    """
    sigma_px = _stated_px(night, sensors)
    if np.isnan(sigma_px).any():  # else the detections need not be read
        of_detections = _sigmas_px(night, sensors, calibrations)
        sigma_px = np.where(np.isnan(sigma_px), of_detections, sigma_px)
    sums = _ResidualSums(sensors, sigma_px, _sizes(night, sensors))
    for rows in night.pieces("stars", COLUMNS):
        sums.add(rows)
    return sums.result() if sums.stars.sum() else None


def _stated_px(night: NightReader, sensors: list[str]) -> Array:
    """Return the stated sigma of each sensor's stars; NaN where the stars were not compared."""
    rows = night.read("checks", ["sensor_id", "check", "expected"])
    compared = rows.filter(pl.col("check") == LogCheck.CENTROID_SIGMA.value)
    of = dict(compared.select("sensor_id", "expected").drop_nulls().iter_rows())
    return np.array([of.get(name, np.nan) for name in sensors])


def _sigmas_px(night: NightReader, sensors: list[str], calibrations: pl.DataFrame) -> Array:
    focal_px = np.full(len(sensors), np.nan)
    number = {name: k for k, name in enumerate(sensors)}
    for name, fx, fy in calibrations.select("sensor_id", "fx_px", "fy_px").iter_rows():
        if name in number:
            focal_px[number[name]] = np.sqrt(abs(fx * fy))
    counts = np.zeros((len(sensors), len(SIGMA_BINS) + 1), np.int64)
    for rows in night.pieces("detections", ["sensor_id", "sigma_arcsec"]):
        at = np.searchsorted(SIGMA_BINS, rows["sigma_arcsec"].to_numpy())
        np.add.at(counts, (codes(rows["sensor_id"], sensors), at), 1)
    share = np.cumsum(counts, axis=1) / np.maximum(counts.sum(axis=1, keepdims=True), 1)
    middle = np.argmax(share >= 0.5, axis=1)
    centres = np.sqrt(SIGMA_BINS[1:] * SIGMA_BINS[:-1])
    sigma_arcsec = centres[np.clip(middle - 1, 0, len(centres) - 1)]
    found = counts.sum(axis=1) > 0
    return np.where(found, sigma_arcsec * ARCSEC * focal_px, np.nan)


def _sizes(night: NightReader, sensors: list[str]) -> Array:
    """Return the largest pixel positions of stars and detections: nearly the size of the image."""
    largest = np.ones((len(sensors), 2))
    number = {name: k for k, name in enumerate(sensors)}
    for table in ("stars", "detections"):
        for rows in night.pieces(table, ["sensor_id", "x_px", "y_px"]):
            of_sensor = rows.group_by("sensor_id").agg(pl.col("x_px", "y_px").max())
            for name, x, y in of_sensor.iter_rows():
                if name in number:
                    k = number[name]
                    largest[k] = np.maximum(largest[k], [x + 1.0, y + 1.0])
    return largest


class _ResidualSums:
    """The sums over the pieces of the table."""

    def __init__(self, sensors: list[str], sigma_px: Array, size_px: Array) -> None:
        n = len(sensors)
        self.sensors, self.sigma_px, self.size_px = sensors, sigma_px, size_px
        self.counts = np.zeros((n, len(HISTOGRAM) - 1), np.int64)
        self.squares, self.stars = np.zeros(n), np.zeros(n, np.int64)
        self.sums = np.zeros((2, n * CELLS * CELLS))
        self.in_cell = np.zeros(n * CELLS * CELLS, np.int64)

    def add(self, rows: pl.DataFrame) -> None:
        """Add a piece of the table."""
        sensor = codes(rows["sensor_id"], self.sensors)
        x, y, dx, dy = (rows[name].to_numpy() for name in COLUMNS[2:])
        n = len(self.sensors)
        self.stars += np.bincount(sensor, minlength=n)
        freedom = np.sqrt(np.maximum(1 - FITTED / (2 * _stars_of_frame(rows, sensor)), 0.1))
        for residual in (dx, dy):
            z = residual / (self.sigma_px[sensor] * freedom)
            known = np.isfinite(z)
            self.squares += np.bincount(sensor[known], z[known] ** 2, n)
            at = np.clip(np.searchsorted(HISTOGRAM, z[known]) - 1, 0, self.counts.shape[1] - 1)
            np.add.at(self.counts, (sensor[known], at), 1)
        column = np.clip(x / self.size_px[sensor, 0] * CELLS, 0, CELLS - 1).astype(np.int64)
        row = np.clip(y / self.size_px[sensor, 1] * CELLS, 0, CELLS - 1).astype(np.int64)
        cell = (sensor * CELLS + row) * CELLS + column
        self.in_cell += np.bincount(cell, minlength=len(self.in_cell))
        for k, residual in enumerate((dx, dy)):
            self.sums[k] += np.bincount(cell, residual, len(self.in_cell))

    def result(self) -> StarResiduals:
        """Return the residuals."""
        shape = (len(self.sensors), CELLS, CELLS)
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = np.moveaxis((self.sums / self.in_cell).reshape(2, *shape), 0, -1)
            known = np.isfinite(self.sigma_px)
            mean_square = np.where(known, self.squares / (2 * self.stars), np.nan)
        return StarResiduals(self.sensors, self.counts, mean_square, self.stars, self.sigma_px,
                             self.size_px, mean, self.in_cell.reshape(shape))  # fmt: skip


def _stars_of_frame(rows: pl.DataFrame, sensor: Indices) -> Indices:
    """Return, for each star, how many its frame has: the rows of a frame follow one another."""
    time_ns = rows["time"].dt.epoch("ns").to_numpy()
    new = np.ones(len(sensor), bool)
    new[1:] = (np.diff(time_ns) != 0) | (np.diff(sensor) != 0)
    frame = np.cumsum(new) - 1
    counts: Indices = np.bincount(frame)[frame]
    return counts


# The map of a frame: stars with names, residuals, and detections.

SEARCHED_NS = 120_000_000_000  # of the night's middle
MAX_OTHERS = 300


class StarMap(NamedTuple):
    """A frame.

    star_id, magnitude : (n,)
    stars_px, residuals_px : (n, 2) pixel positions and residuals of its stars
    others_px : (m, 2) detections that are no stars, the brightest
    objects : (m,) which of them belong to a track
    says, others_say : what each star and each other detection is
    status : why it is not identified; None: it is
    """

    sensor_id: str
    frame_number: int
    time_ns: int
    star_id: Indices
    magnitude: Array
    stars_px: Array
    residuals_px: Array
    others_px: Array
    objects: Flags
    says: list[str]
    others_say: list[str]
    status: str | None = None


def read_star_map(night: NightReader, series: FrameSeries) -> StarMap | None:
    """Return a frame near the middle of the night with as many stars as is usual for its sensor.

    It is of the sensor with the most identified frames. None: no frame is identified, or the
    table `stars` leaves out all of that sensor.
    """
    identified = series.counts[0]
    if not identified.sum():
        return None
    k = int(np.argmax(identified.sum(axis=1)))
    candidates = np.flatnonzero(identified[k])
    bin_ = int(candidates[np.argmin(np.abs(candidates - series.bins.number / 2))])
    frame = _usual_frame(night, series, k, bin_)
    if frame is None:
        return None
    return _map_of(night, series.sensors[k], *frame)


def read_frame_concerned(night: NightReader, series: FrameSeries, k: int) -> StarMap | None:
    """Return the frame of a sensor that needs a look the most.

    One that is not identified, of the time with most of these; of a sensor whose frames all are,
    the one with the largest star residual. None: it has neither.
    """
    failed = series.counts[1:, k].sum(axis=0)
    residual = np.nan_to_num(series.rms["residual"][k])
    if not failed.any() and not residual.any():
        return None
    bin_ = int(np.argmax(failed if failed.any() else residual))
    length = (series.bins.end_ns - series.bins.start_ns) / series.bins.number
    start = series.bins.start_ns + int(bin_ * length)
    between_ns = start, start + int(length) + 2
    columns = ["time", "sensor_id", "frame_number", "status", "residual_px"]
    pieces = night.pieces("frames", columns, between_ns)
    of_sensor = [rows.filter(sensor_id=series.sensors[k]) for rows in pieces]
    found = pl.concat([night.empty("frames", columns), *of_sensor])
    chosen = found.drop_nulls("status") if failed.any() else found.drop_nulls("residual_px")
    drawable = chosen.filter(_in_stars(night, series.sensors[k], between_ns))
    chosen = drawable if len(drawable) else chosen
    chosen = chosen.sort("residual_px", descending=True, nulls_last=True, maintain_order=True)
    if not len(chosen):
        return None
    row = chosen.row(0, named=True)
    time_ns = int(chosen["time"].dt.epoch("ns")[0])
    made = _map_of(night, series.sensors[k], row["frame_number"], time_ns)
    return made._replace(status=row["status"])


def _map_of(night: NightReader, sensor_id: str, number: int, time_ns: int) -> StarMap:
    in_frame = (pl.col("sensor_id") == sensor_id) & (pl.col("frame_number") == number)
    columns = ["time", "sensor_id", "frame_number", "x_px", "y_px"]
    stars = _rows(night, "stars", [*columns, "star_id", "magnitude", "dx_px", "dy_px"], time_ns)
    seen = [*columns, "flux", "track_id", "tracklet_id", "sigma_arcsec", "kind"]
    others = _rows(night, "detections", seen, time_ns).filter(in_frame)
    others = others.sort("flux", descending=True, nulls_last=True, maintain_order=True)
    others, stars = others.head(MAX_OTHERS), stars.filter(in_frame)
    return StarMap(
        sensor_id, number, time_ns,
        stars["star_id"].to_numpy(), stars["magnitude"].to_numpy(),
        stars.select("x_px", "y_px").to_numpy(), stars.select("dx_px", "dy_px").to_numpy(),
        others.select("x_px", "y_px").to_numpy(), others["track_id"].is_not_null().to_numpy(),
        [_of_star(row) for row in stars.to_dicts()], [_of_other(row) for row in others.to_dicts()],
    )  # fmt: skip


def _of_star(row: dict[str, Any]) -> str:
    return (
        f"star {row['star_id']}: magnitude {row['magnitude']:.2f}, at {row['x_px']:.1f}, "
        f"{row['y_px']:.1f} px, residual {row['dx_px']:+.3f}, {row['dy_px']:+.3f} px"
    )


def _of_other(row: dict[str, Any]) -> str:
    of = f"tracklet {row['tracklet_id']}" if row["tracklet_id"] else "no tracklet"
    sigma = row["sigma_arcsec"]
    stated = f", sigma {sigma:.2g} arcsec" if sigma is not None else ""
    return f"{row['kind']}, {of}: at {row['x_px']:.1f}, {row['y_px']:.1f} px{stated}"


def _usual_frame(
    night: NightReader, series: FrameSeries, k: int, bin_: int
) -> tuple[int, int] | None:
    """Return number and time of the frame whose number of stars is nearest to the mean.

    Of the frames whose stars are published (`stars_every` leaves out those of others): in a part
    of the bin, else in all of it, else in the whole night.
    """
    length = (series.bins.end_ns - series.bins.start_ns) / series.bins.number
    start = series.bins.start_ns + int(bin_ * length)
    columns = ["time", "sensor_id", "frame_number", "attitude_source", "n_stars"]
    for between_ns in (
        (start, start + min(int(length) + 1, SEARCHED_NS)),
        (start, start + int(length) + 2),
        (series.bins.start_ns, series.bins.end_ns),
    ):
        is_drawable = _in_stars(night, series.sensors[k], between_ns)
        of_sensor = [
            rows.filter(is_drawable, sensor_id=series.sensors[k], attitude_source="stars")
            for rows in night.pieces("frames", columns, between_ns)
        ]
        frames = pl.concat([night.empty("frames", columns), *of_sensor])
        if len(frames):
            at = int(np.argmin(np.abs(frames["n_stars"].to_numpy() - series.stars[k])))
            return int(frames["frame_number"][at]), int(frames["time"].dt.epoch("ns")[at])
    return None


def _in_stars(night: NightReader, sensor_id: str, between_ns: tuple[int, int]) -> pl.Expr:
    """Return whether a frame of a sensor is in the table `stars`, by its number."""
    numbers = [
        rows.filter(sensor_id=sensor_id)["frame_number"].unique()
        for rows in night.pieces("stars", ["time", "sensor_id", "frame_number"], between_ns)
    ]
    return pl.col("frame_number").is_in(pl.concat([pl.Series(dtype=pl.Int64), *numbers]).implode())


def _rows(night: NightReader, table: str, columns: list[str], time_ns: int) -> pl.DataFrame:
    pieces = list(night.pieces(table, columns, (time_ns, time_ns + 1)))
    return pl.concat(pieces) if pieces else night.empty(table, columns)

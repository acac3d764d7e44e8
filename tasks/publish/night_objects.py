"""Objects of a night: a row for each, made from the other tables."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
from scipy.special import chdtrc

from epipole.io.datasets.night_tables import NightReader, write_table
from epipole.io.datasets.rows_by_night import in_order
from epipole.schemas.bridge import from_polars
from epipole.schemas.rejects import Found, NameStatus, ObjectVerdict
from epipole.schemas.stages import Stage
from epipole.schemas.tables import OBJECTS
from epipole.tasks.algorithms.log_checks.findings import SENSORS_AGREE
from epipole.tasks.common.stage_tasks import stage_task

MOST = 0.5  # share of an object's observations or positions
MIN_PROBABILITY = 1e-6  # of a chi-square: views with a less probable one disagree
SINE = 2 * np.sqrt(2)  # a sine from its minimum to its maximum, over its standard deviation

_OBSERVED = [
    "time", "object_id", "tracklet_id", "sensor_id", "blended", "magnitude", "magnitude_sigma",
    "magnitude_1000_km",
]  # fmt: skip
_POSITIONS = ["time", "object_id", "n_sensors", "n_rejected", "chi2", "independent"]
_NAMES = ["norad_id", "cospar_id", "name"]


@stage_task(Stage.PUBLISH, "objects of {night}")
def write_objects(folder: Path, night: str, verdicts: Mapping[str, ObjectVerdict]) -> int:
    """Write the table `objects` of a night whose other tables are written; return its rows.

    `verdicts` are those of objects whose observations fit no single orbit.
    """
    reader = NightReader.of_folder(folder, night)
    return write_table(folder, "objects", [objects_of(reader, verdicts)])


def objects_of(reader: NightReader, verdicts: Mapping[str, ObjectVerdict]) -> pa.Table:
    """Return OBJECTS of a night: all that have a position or an observation in it, in order."""
    seen, solved = _observed(reader), _solved(reader)
    rows = seen.join(solved, on="object_id", how="full", coalesce=True, suffix="_solved")
    rows = rows.with_columns(pl.col(r"^n_.*$").fill_null(0))
    has_orbit = reader.read("orbits", ["object_id"])["object_id"]
    in_doubt = SENSORS_AGREE in reader.read("checks", ["check"])["check"].to_list()
    rows = rows.with_columns(in_doubt=pl.lit(in_doubt) & (pl.col("n_positions") > 0))
    rows = rows.with_columns(
        first_time=pl.min_horizontal("first_time", "first_time_solved"),
        last_time=pl.max_horizontal("last_time", "last_time_solved"),
        found=pl.when(pl.col("n_positions") > 0)
        .then(pl.lit(Found.TOGETHER.value))
        .otherwise(pl.lit(Found.LINKED.value)),
        verdict=_verdicts(rows, verdicts, has_orbit),
    )
    names = reader.read("identifications", ["object_id", "status", *_NAMES])
    known = names.filter(pl.col("status") == NameStatus.KNOWN.value).drop_nulls("object_id")
    return in_order(from_polars(OBJECTS, rows.join(known, on="object_id", how="left")))


def _observed(reader: NightReader) -> pl.DataFrame:
    """Return what the observations tell of each object: times, counts, magnitudes."""
    magnitude, reduced, variance = (
        pl.when(pl.col("blended").not_()).then(values)
        for values in ("magnitude", "magnitude_1000_km", pl.col("magnitude_sigma") ** 2)
    )
    sums, members = [], []
    empty = reader.empty("observations", _OBSERVED)
    for piece in (empty, *reader.pieces("observations", _OBSERVED)):
        rows = piece.drop_nulls("object_id")
        sums.append(
            rows.group_by("object_id", maintain_order=True).agg(
                first_time=pl.col("time").min(), last_time=pl.col("time").max(),
                n_observations=pl.len(), n_blended=pl.col("blended").sum(),
                n_bright=magnitude.count(), total=magnitude.sum(),
                n_reduced=reduced.count(), reduced=reduced.sum(), square=(reduced**2).sum(),
                noise=variance.filter(reduced.is_not_null()).sum(),
            )
        )  # fmt: skip
        members.append(rows.select("object_id", "sensor_id", "tracklet_id").unique())
    total = pl.col("total", "reduced", "square", "noise", r"^n_.*$").sum()
    counts = pl.concat(members).unique().group_by("object_id", maintain_order=True).agg(
        n_sensors=pl.col("sensor_id").n_unique(),
        n_tracklets=pl.col("tracklet_id").drop_nulls().n_unique(),
    )  # fmt: skip
    ends = pl.col("first_time").min(), pl.col("last_time").max()
    rows = pl.concat(sums).group_by("object_id", maintain_order=True).agg(*ends, total)
    return rows.join(counts, on="object_id").with_columns(**_brightness())


def _brightness() -> dict[str, pl.Expr]:
    """Return mean and amplitude of the magnitudes, from their sums."""
    n = pl.col("n_reduced")
    scatter = (pl.col("square") - pl.col("reduced") ** 2 / n) / (n - 1) - pl.col("noise") / n
    amplitude = SINE * pl.max_horizontal(scatter, 0.0).sqrt()
    bright = pl.col("n_bright")
    return {
        "magnitude": pl.when(bright > 0).then(pl.col("total") / bright),
        "magnitude_amplitude": pl.when(n > 1).then(amplitude),
    }


def _solved(reader: NightReader) -> pl.DataFrame:
    """Return what the positions tell of each object: times, counts, chi-squares."""
    alone = pl.col("independent")
    pieces = [
        rows.group_by("object_id", maintain_order=True).agg(
            first_time=pl.col("time").min(), last_time=pl.col("time").max(),
            n_positions=pl.len(), n_rejected=(pl.col("n_rejected") > 0).sum(),
            n_views=pl.col("n_sensors").max(), n_alone=alone.sum(),
            chi2=pl.col("chi2").filter(alone).sum(),
            dof=(2.0 * pl.col("n_sensors") - 3.0).filter(alone).sum(),
        )
        for rows in (reader.empty("positions", _POSITIONS), *reader.pieces("positions", _POSITIONS))
    ]  # fmt: skip
    return pl.concat(pieces).group_by("object_id", maintain_order=True).agg(
        pl.col("first_time").min(), pl.col("last_time").max(), pl.col("n_views").max(),
        pl.col("n_positions", "n_rejected", "n_alone", "chi2", "dof").sum(),
    )  # fmt: skip


def _verdicts(
    rows: pl.DataFrame, of_orbits: Mapping[str, ObjectVerdict], has_orbit: pl.Series
) -> pl.Series:
    """Return the `ObjectVerdict` of each object.

    Positions share errors, so the mean of their chi-squares is compared with that of one position.
    """
    chi2, dof = (
        rows.select(pl.col(name).fill_null(0.0) / pl.max_horizontal("n_alone", 1)).to_series()
        for name in ("chi2", "dof")
    )
    disagrees = pl.Series(chdtrc(dof.to_numpy(), chi2.to_numpy()) < MIN_PROBABILITY)
    is_rejected = pl.col("n_rejected") > MOST * pl.col("n_positions")
    is_two = pl.col("n_views") == 2
    first_true = {
        ObjectVerdict.BLENDED: pl.col("n_blended") > MOST * pl.col("n_observations"),
        ObjectVerdict.TWO_SENSORS_DISAGREE: disagrees & is_two,
        ObjectVerdict.SENSORS_DISAGREE: disagrees | is_rejected,
        ObjectVerdict.SENSORS_IN_DOUBT: pl.col("in_doubt"),
        ObjectVerdict.MANOEUVRED: _has(of_orbits, ObjectVerdict.MANOEUVRED),
        ObjectVerdict.ORBIT_MISFIT: _has(of_orbits, ObjectVerdict.ORBIT_MISFIT),
        ObjectVerdict.NO_ORBIT: pl.col("object_id").is_in(has_orbit.implode()).not_(),
    }
    verdicts = pl.coalesce(
        *(pl.when(true).then(pl.lit(verdict.value)) for verdict, true in first_true.items()),
        pl.lit(ObjectVerdict.SOUND.value),
    )
    return rows.select(verdicts.alias("verdict")).to_series()


def _has(verdicts: Mapping[str, ObjectVerdict], verdict: ObjectVerdict) -> pl.Expr:
    names = [name for name, each in verdicts.items() if each == verdict]
    return pl.col("object_id").is_in(pl.Series(names, dtype=pl.String).implode())

"""Name tracklets: compare those that belong to no object with positions with a catalogue.

Objects that have no positions are named by their tracklets. The errors of the elements are learnt
once more, from the sure matches of the night's tracklets. Then all are judged with them.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.io.datasets.night_tables import read_columns
from epipole.schemas.arrays import Flags, Indices
from epipole.schemas.bridge import nullable
from epipole.schemas.columns import ATTRIBUTABLE_AXES, POSITION, VELOCITY, upper_triangle
from epipole.schemas.rejects import NameStatus
from epipole.tasks.algorithms.constants import ARCSEC
from epipole.tasks.algorithms.known_objects.matching import (
    SURE,
    KnownSatellites,
    with_learnt_errors,
)
from epipole.tasks.algorithms.known_objects.tracklet_matching import (
    PairWeights,
    TrackletNames,
    judge_tracklets,
    match_tracklets,
    residuals_of,
    weigh_pairs,
)
from epipole.tasks.algorithms.known_objects.tracklet_search import Pairs, SeenTracklets
from epipole.tasks.common.tracklet_arrays import covariance_of
from epipole.tasks.name.elements_of_night import (
    CatalogueNames,
    ElementsOfNight,
    identification_rows,
    names_of,
)

MAX_LEARNT = 300  # tracklets, evenly chosen: they tell the errors to a tenth
_COVARIANCE = [f"cov_{a}{b}" for a, b in upper_triangle(ATTRIBUTABLE_AXES)]
_COLUMNS = [
    "tracklet_id", "track_id", "object_id", "sensor_id", "start_time", "end_time", "epoch",
    "ra_deg", "dec_deg", "ra_rate_arcsec_s", "dec_rate_arcsec_s", *_COVARIANCE,
    "bias_sigma_arcsec", *POSITION, *VELOCITY, "position_sigma_km", "magnitude",
]  # fmt: skip


# Whether a tracklet has a direction with rates, and its sensor a position and velocity.
HAS_DIRECTION = pl.all_horizontal(pl.col("epoch", "cov_rara", *POSITION, *VELOCITY).is_not_null())


class NamedTracklets(NamedTuple):
    """Objects and tracklets of a night, and their names.

    Each has an `object_id` or a `tracklet_id`. `row` is its row in `names`, which are of tracklets;
    `pairs` and `weights` are what these point to.
    """

    object_id: list[str | None]
    tracklet_id: list[str | None]
    row: Indices
    names: TrackletNames
    pairs: Pairs
    weights: PairWeights


def name_tracklets(
    folder: Path,
    objects: Mapping[str, int | None],
    catalogue: KnownSatellites,
    min_probability: float,
) -> NamedTracklets:
    """Return what a catalogue says of the tracklets of a night that belong to none of its objects.

    Those that an orbit joins to an object give this object a name: of the satellites that fit all
    of them, that of the tracklet that decides most clearly. The errors of the elements are the
    same in all of them, so their evidence is not added.

    Parameters
    ----------
    folder
        The night's folder; its `tracklets` are written.
    objects
        The satellites of objects that have positions, which are named by these; None where one
        is unknown.
    catalogue
        Its errors of elements are those that the night's objects show.
    min_probability
        Minimum probability of a name that is given.
    """
    rows = pl.DataFrame(read_columns(folder, "tracklets", _COLUMNS))
    is_named = pl.col("object_id").is_in(list(objects)).fill_null(False)
    of_named, rows = rows.filter(is_named), rows.filter(~is_named).sort("tracklet_id")
    compared = np.flatnonzero(rows.select(HAS_DIRECTION).to_series().to_numpy())
    tracklets = _tracklets(rows[compared])
    pairs = match_tracklets(tracklets, catalogue)
    catalogue = _learnt(tracklets, pairs, catalogue)
    weights = weigh_pairs(tracklets, pairs, catalogue)
    pairs = pairs._replace(tracklet=compared[pairs.tracklet])
    weights = weights._replace(fits=_fits_all(weights.fits, pairs, rows, compared))
    names = judge_tracklets(len(rows), pairs, weights, min_probability)
    row = _deciding(names, rows)
    satellite = pl.Series([objects[name] for name in of_named["object_id"]], dtype=pl.Int64)
    of_objects = of_named.with_columns(satellite=satellite).drop_nulls("satellite")
    names = _without_rivals(names, pairs, rows, row, of_objects)
    kept = np.unique(row)
    object_id = rows["object_id"].gather(kept)
    tracklet_id = rows["tracklet_id"].gather(kept).set(object_id.is_not_null(), None)
    return NamedTracklets(object_id.to_list(), tracklet_id.to_list(), kept, names, pairs, weights)


def sampled_tracklets(folder: Path, most: int) -> SeenTracklets:
    """Return at most `most` of a night's tracklets, evenly chosen."""
    rows = pl.DataFrame(read_columns(folder, "tracklets", _COLUMNS)).sort("tracklet_id")
    rows = rows.filter(HAS_DIRECTION)
    return _tracklets(rows[:: max(-(-len(rows) // most), 1)])


def _fits_all(fits: Flags, pairs: Pairs, rows: pl.DataFrame, compared: Indices) -> Flags:
    """Return which pairs fit; those of an object, whether all its tracklets fit the satellite."""
    members = rows[compared].group_by("object_id").agg(members=pl.len())
    of = rows.select("object_id")[pairs.tracklet].with_columns(satellite=pairs.satellite, fits=fits)
    of = of.join(members, on="object_id", how="left", maintain_order="left")
    all_fit = pl.col("fits").sum().over("object_id", "satellite") == pl.col("members")
    return np.asarray(
        of.select(pl.when(pl.col("object_id").is_null()).then("fits").otherwise(all_fit))
        .to_series()
        .to_numpy(),
        bool,
    )


def _deciding(names: TrackletNames, rows: pl.DataFrame) -> Indices:
    """Return, for each tracklet, the row with the clearest name of its object, or its row."""
    rank = pl.Series(names.status).replace_strict(
        [status.value for status in NameStatus], range(len(NameStatus)), return_dtype=pl.Int64
    )
    of = rows.select("object_id").with_row_index("row")
    of = of.with_columns(rank=rank, doubt=pl.Series(-names.probability))
    clearest = pl.col("row").sort_by("rank", "doubt", "row").first().over("object_id")
    row = pl.when(pl.col("object_id").is_null()).then("row").otherwise(clearest)
    return of.select(row.cast(pl.Int64).alias("row")).to_series().to_numpy()


def _tracklets(rows: pl.DataFrame) -> SeenTracklets:
    return SeenTracklets(
        time_ns=rows["epoch"].cast(pl.Int64).to_numpy(),
        ra_dec=np.radians(rows.select("ra_deg", "dec_deg").to_numpy()),
        rates=rows.select("ra_rate_arcsec_s", "dec_rate_arcsec_s").to_numpy() * ARCSEC,
        cov=covariance_of(rows),
        r_km=rows.select(POSITION).to_numpy(),
        v_km_s=rows.select(VELOCITY).to_numpy(),
        position_sigma_km=rows["position_sigma_km"].fill_null(0.0).to_numpy(),
        magnitude=rows["magnitude"].cast(pl.Float64).fill_null(np.nan).to_numpy(),
    )


def _learnt(tracklets: SeenTracklets, pairs: Pairs, catalogue: KnownSatellites) -> KnownSatellites:
    """Return the catalogue with the errors of its elements as some sure matches show them."""
    which = pairs.tracklet % (len(tracklets.time_ns) // MAX_LEARNT + 1) == 0
    pairs = pairs.take(which)
    weights = weigh_pairs(tracklets, pairs, catalogue)
    first = judge_tracklets(len(tracklets.time_ns), pairs, weights, SURE)
    sure = pairs.take(first.pair[first.status == "known"])
    return with_learnt_errors(
        catalogue, sure.satellite.tolist(), residuals_of(tracklets, sure, catalogue)
    )


def _without_rivals(
    names: TrackletNames, pairs: Pairs, rows: pl.DataFrame, row: Indices, of_objects: pl.DataFrame
) -> TrackletNames:
    """Return the names; two tracks of one sensor at one time are not one satellite.

    `row` is that of each tracklet's name. Tracklets of one object have one name. `of_objects` are
    the tracklets of objects whose positions have named a satellite.
    """
    columns = ["sensor_id", "start_time", "end_time"]
    known = np.flatnonzero(names.status[row] == "known")
    of = rows[known].select(*columns, owner=pl.coalesce("object_id", "track_id"))
    of = of.with_columns(row=row[known], satellite=pairs.satellite[names.pair[row[known]]])
    others = of_objects.select(*columns, "satellite", owner="object_id")
    others = pl.concat([of.select(others.columns), others])
    both = of.join(others, on=["sensor_id", "satellite"], suffix="_other").filter(
        pl.col("owner") != pl.col("owner_other"),
        pl.col("start_time") <= pl.col("end_time_other"),
        pl.col("start_time_other") <= pl.col("end_time"),
    )
    rivals = both["row"].unique().to_numpy()
    status = names.status.copy()
    status[rivals] = "ambiguous"
    listed = {int(k): (int(pairs.satellite[names.pair[k]]),) for k in rivals}
    return names._replace(status=status, listed=names.listed | listed)


def tracklet_rows(named: NamedTracklets, known: ElementsOfNight) -> pa.Table:
    """Return their rows of IDENTIFICATIONS."""
    pair, status = named.names.pair[named.row], named.names.status[named.row].tolist()
    satellite = np.full(len(pair), -1)
    satellite[pair >= 0] = named.pairs.satellite[pair[pair >= 0]]
    names = [
        names_of(of, known.sets, best, named.names.listed.get(k, ()))
        if best >= 0
        else CatalogueNames()
        for k, of, best in zip(named.row.tolist(), status, satellite.tolist(), strict=True)
    ]
    columns = {"object_id": named.object_id, "tracklet_id": named.tracklet_id, "status": status}
    fitted = {
        name: nullable(np.append(getattr(named.weights, name), np.nan)[pair])
        for name in ("distance_km", "mahalanobis")
    }
    probability = {"probability": named.names.probability[named.row]}
    return identification_rows(columns | fitted | probability, names, known)

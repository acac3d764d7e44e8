"""Link tracklets: objects that no two sensors saw at the same time, joined by one orbit.

Most passages of a constellation are seen by one sensor at a time. Tracklets of different times are
one object if one orbit explains their attributables, and chance does not. They join an object that
has positions, or become an object without.
"""

import re
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
import polars as pl
import pyarrow as pa

from epipole.schemas.bridge import from_polars, table, to_polars, unstack
from epipole.schemas.rejects import Outcome
from epipole.schemas.settings import LinkingSettings
from epipole.schemas.stages import Stage
from epipole.schemas.work_tables import LINKED_ORBITS, LINKED_TRACKLETS
from epipole.tasks.algorithms.constants import SECOND_NS
from epipole.tasks.algorithms.orbit_linking.grouping import LinkedTracklets
from epipole.tasks.algorithms.orbit_linking.grouping import link_tracklets as link_by_orbit
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.common.tracklet_arrays import (
    HAS_ATTRIBUTABLE,
    attributables_of,
    known_numbers,
)

# Tracklets that may join an object.
FREE = (Outcome.AMBIGUOUS, Outcome.UNDECIDED, Outcome.SEEN_BY_ONE, Outcome.NOT_COMPARED)


class OrbitLinks(NamedTuple):
    """Tracklets that were joined, and objects that are one.

    `tracklets` is LINKED_TRACKLETS, `orbits` LINKED_ORBITS; `renamed` has the new id of each object
    that is the same as an earlier one.
    """

    tracklets: pa.Table
    orbits: pa.Table
    renamed: dict[str, str]


NO_LINKS = OrbitLinks(LINKED_TRACKLETS.empty_table(), LINKED_ORBITS.empty_table(), {})


@stage_task(Stage.NAME, "linked tracklets")
def link_tracklets(
    tracklets: pa.Table, night: str, names: Collection[str], settings: LinkingSettings
) -> OrbitLinks:
    """Return the objects of tracklets that are joined by an orbit.

    Parameters
    ----------
    tracklets
        TRACKLETS of the run, with the ids of the night's objects.
    night
        UTC date. New objects get its date and the numbers after those of the others, in order of
        first appearance.
    names
        Ids of the objects of the run, also of those that no tracklet has.
    """
    if not settings.enabled:
        return NO_LINKS
    rows = _candidates(to_polars(tracklets))
    if rows["known"].n_unique() < 2:
        return NO_LINKS
    found = link_by_orbit(
        attributables_of(rows), rows["known"].to_numpy(), max_gap_s=settings.max_gap_s,
        log_odds=settings.log_odds, max_orbit_gap_s=settings.max_orbit_gap_s,
    )  # fmt: skip
    links = _name(rows.with_columns(label=pl.Series(found.label)), night, names)
    return links._replace(orbits=_orbits(rows, found, links.tracklets))


def _candidates(rows: pl.DataFrame) -> pl.DataFrame:
    """Return the tracklets that take part, in order of time, with their `known_numbers`."""
    free = pl.col("outcome").is_in([outcome.value for outcome in FREE])
    rows = rows.filter(HAS_ATTRIBUTABLE, pl.col("object_id").is_not_null() | free)
    rows = rows.sort("epoch", "tracklet_id")
    return rows.with_columns(known=known_numbers(rows))


def _name(rows: pl.DataFrame, night: str, names: Collection[str]) -> OrbitLinks:
    """Return the links of labelled tracklets: the earliest object of a label gives its id."""
    joined = rows.filter(pl.col("known").n_unique().over("label") > 1)
    renamed = _one_object(joined)
    named = joined.with_columns(pl.col("object_id").replace(renamed).alias("id"))
    named = named.with_columns(pl.col("id").drop_nulls().first().over("label"))
    in_night = (pl.col("epoch").dt.date().cast(pl.String) == night).any().over("label")
    unnamed = named.filter(pl.col("id").is_null() & in_night)
    date = night.replace("-", "")
    taken = [re.fullmatch(f"{date}-(\\d+)", name) for name in names]
    next_number = max((int(number[1]) for number in taken if number), default=0) + 1
    new = {
        label: f"{date}-{next_number + k:05d}"
        for k, label in enumerate(unnamed["label"].unique(maintain_order=True).to_list())
    }
    by_label = pl.col("label").replace_strict(new, default=None, return_dtype=pl.String)
    linked = named.filter(pl.col("object_id").is_null())
    linked = linked.select("tracklet_id", pl.coalesce("id", by_label).alias("object_id"))
    return NO_LINKS._replace(
        tracklets=from_polars(LINKED_TRACKLETS, linked.drop_nulls()), renamed=renamed
    )


def _orbits(rows: pl.DataFrame, found: LinkedTracklets, linked: pa.Table) -> pa.Table:
    """Return LINKED_ORBITS of the objects that have no other tracklets than `linked`."""
    first = found.label == np.arange(len(rows))
    joined = np.flatnonzero(first & np.isfinite(found.epoch_s))
    names = rows.select("tracklet_id").join(
        to_polars(linked), on="tracklet_id", how="left", maintain_order="left"
    )
    names = names.with_columns(known=rows["object_id"], label=pl.Series(found.label))
    ids = names.select(pl.when(pl.col("known").is_null().all().over("label")).then("object_id"))[
        "object_id"
    ].to_numpy()[joined]
    kept = np.array([name is not None for name in ids], bool)
    origin = rows["epoch"].cast(pl.Int64).min()
    columns = {
        "object_id": ids[kept].tolist(),
        "epoch": origin + np.rint(found.epoch_s[joined][kept] * SECOND_NS).astype(np.int64),
        **unstack("{}_km", found.state[joined][kept, :3]),
        **unstack("v{}_km_s", found.state[joined][kept, 3:]),
    }
    return table(LINKED_ORBITS, columns)


def _one_object(joined: pl.DataFrame) -> dict[str, str]:
    """Return the new ids of objects that are the same as an earlier one.

    Objects of which two tracklets were seen at the same time keep their ids: an object has one
    position per epoch.
    """
    known = joined.drop_nulls("object_id").sort("start_time", "tracklet_id")
    known = known.filter(pl.col("object_id").n_unique().over("label") > 1)
    renamed: dict[str, str] = {}
    for _, of_label in known.group_by("label", maintain_order=True):
        objects = of_label.partition_by("object_id", maintain_order=True)
        first = objects[0]
        for other in objects[1:]:
            if not _at_once(first, other):
                renamed[other["object_id"][0]] = first["object_id"][0]
                first = pl.concat([first, other])
    return renamed


def _at_once(one: pl.DataFrame, other: pl.DataFrame) -> bool:
    """Return whether two objects have tracklets at the same time."""
    start, end = (one[name].to_numpy()[:, None] for name in ("start_time", "end_time"))
    return bool(
        ((other["start_time"].to_numpy() <= end) & (start <= other["end_time"].to_numpy())).any()
    )

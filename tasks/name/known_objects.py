"""Name known objects: compare each object of a night with a catalogue and with earlier nights.

The errors of the elements are learnt from the certain matches of the night. Then all objects that
have positions are judged with them, and after them the tracklets of others and of none.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.compute as pc

from epipole.io.datasets.night_tables import read_columns, take_rows, write_table
from epipole.schemas.bridge import (
    array,
    concat,
    from_polars,
    rows_with,
    stack,
    stack_covariance,
    to_polars,
)
from epipole.schemas.columns import POSITION
from epipole.schemas.rejects import NameStatus
from epipole.schemas.settings import KnownObjectSettings
from epipole.schemas.stages import Stage
from epipole.schemas.tables import IDENTIFICATIONS
from epipole.tasks.algorithms.known_objects.matching import (
    SURE,
    KnownSatellites,
    NameVerdict,
    Observed,
    candidates,
    judge,
    spread_rows,
    with_learnt_errors,
)
from epipole.tasks.algorithms.known_objects.prediction import (
    HIGH_ORBIT,
    LOW_ORBIT,
    Screen,
    satellites_of,
)
from epipole.tasks.common.stage_tasks import stage_task
from epipole.tasks.name.earlier_objects import EarlierObjects, recognise_objects
from epipole.tasks.name.elements_of_night import (
    CatalogueNames,
    ElementsOfNight,
    identification_rows,
    names_of,
)
from epipole.tasks.name.known_tracklets import name_tracklets, tracklet_rows
from epipole.tasks.name.sensor_residuals import SensorResidual, sensor_residuals

UNSEEN_NS = 600_000_000_000  # a longer time without a position ends a run of them
Times = tuple[int, int]  # first and last, ns since 1970

_COVARIANCE = ["cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz"]


@stage_task(Stage.NAME, "known objects")
def name_known_objects(
    folder: Path,
    known: ElementsOfNight | None,
    earlier: EarlierObjects,
    settings: KnownObjectSettings,
    link_log_odds: float,
) -> list[SensorResidual]:
    """Write the table `identifications` of a night whose other tables are written.

    Parameters
    ----------
    folder
        The night's folder.
    known
        None: without a catalogue; all objects are unknown, and other tracklets have no rows.
    earlier
        Objects of earlier nights.

    Returns
    -------
    list
        How far each sensor's detections of known objects are from their predictions.
    """
    observed, times = observed_objects(folder)
    verdicts: dict[str, NameVerdict] = {}
    others = IDENTIFICATIONS.empty_table()
    if known is not None:
        verdicts, learnt = judge_objects(observed, known, settings.probability)
        verdicts = _without_rivals(verdicts, times)
        satellites = {name: _satellite(verdict) for name, verdict in verdicts.items()}
        named = name_tracklets(folder, satellites, learnt, settings.probability)
        others = tracklet_rows(named, known)
    objects = sorted(observed.keys() | _seen_objects(folder) - set(others["object_id"].to_pylist()))
    rows = concat(IDENTIFICATIONS, [_rows(objects, verdicts, known), others])
    same_as = recognise_objects(folder, _unknown(rows), earlier, settings.earlier_h, link_log_odds)
    before = pl.col("object_id").replace_strict(same_as, default=None, return_dtype=pl.String)
    known_as = to_polars(rows).with_columns(same_as=before)
    known_as = known_as.sort("object_id", nulls_last=True, maintain_order=True)
    write_table(folder, "identifications", [from_polars(IDENTIFICATIONS, known_as)])
    if known is None:
        return []
    return sensor_residuals(
        folder,
        {n: known.sets[k] for n, v in verdicts.items() if (k := _satellite(v)) is not None},
    )


def _satellite(verdict: NameVerdict) -> int | None:
    """Return the row of the known satellite; None: it is not known."""
    return verdict.best.row if verdict.status == "known" and verdict.best is not None else None


def _unknown(rows: pa.Table) -> list[str]:
    """Return the objects of IDENTIFICATIONS that no catalogue names."""
    named = rows_with(rows, "status", NameStatus.KNOWN)["object_id"]
    return sorted(set(rows["object_id"].to_pylist()) - set(named.to_pylist()) - {None})


def _seen_objects(folder: Path) -> set[str]:
    """Return the objects that have observations; those without positions are among them."""
    rows = read_columns(folder, "observations", ["object_id"])
    return set(pc.unique(rows["object_id"]).drop_null().to_pylist())


def observed_objects(folder: Path) -> tuple[dict[str, Observed], dict[str, list[Times]]]:
    """Return some positions of each object, by id in order, and the times when it was seen."""
    index = pl.DataFrame(read_columns(folder, "positions", ["object_id", "time", "independent"]))
    chosen = []
    for rows in index.with_row_index("row").partition_by("object_id", maintain_order=True):
        times = rows["time"].cast(pl.Int64).to_numpy()
        spread = spread_rows(times, rows["independent"].to_numpy())
        chosen.append(rows["row"].to_numpy()[spread].astype(np.int64))
    taken = np.sort(np.concatenate([np.zeros(0, np.int64), *chosen]))
    columns = ["object_id", "time", *POSITION, *_COVARIANCE]
    rows = take_rows(folder, "positions", columns, taken)
    names, time_ns = array(rows, "object_id"), array(rows, "time")
    r_km, cov = stack(rows, "{}_km"), stack_covariance(rows, "cov_{}")
    found = {}
    for name in sorted(set(names.tolist())):
        of_name = np.flatnonzero(names == name)
        of_name = of_name[np.argsort(time_ns[of_name], kind="stable")]
        found[name] = Observed(time_ns[of_name], r_km[of_name], cov[of_name])
    return found, _seen_times(index)


def _seen_times(positions: pl.DataFrame) -> dict[str, list[Times]]:
    """Return the first and last time of each unbroken run of an object's positions."""
    rows = positions.select("object_id", pl.col("time").cast(pl.Int64)).sort("object_id", "time")
    begins = (pl.col("time").diff().over("object_id") > UNSEEN_NS).fill_null(True)
    runs = rows.group_by("object_id", begins.cum_sum().alias("run"), maintain_order=True).agg(
        first=pl.col("time").first(), last=pl.col("time").last()
    )
    times: dict[str, list[Times]] = {}
    for name, first, last in runs.select("object_id", "first", "last").iter_rows():
        times.setdefault(name, []).append((first, last))
    return times


def catalogue_of(known: ElementsOfNight) -> KnownSatellites:
    """Return the catalogue with usual errors of its elements."""
    epoch_ns = np.array([each.epoch_ns for each in known.sets], np.int64)
    return KnownSatellites(satellites_of(known.elements), epoch_ns, LOW_ORBIT, HIGH_ORBIT)


def judge_objects(
    observed: Mapping[str, Observed], known: ElementsOfNight, least: float
) -> tuple[dict[str, NameVerdict], KnownSatellites]:
    """Return what each object is, and the catalogue with the errors that the sure matches show."""
    catalogue = catalogue_of(known)
    screen = Screen(catalogue.satellites)
    first = {name: candidates(of, catalogue, screen) for name, of in observed.items()}
    judged = [judge(found, SURE) for found in first.values()]
    sure = [each.best for each in judged if each.status == "known" and each.best is not None]
    learnt = with_learnt_errors(catalogue, [each.row for each in sure], sure)
    verdicts = {
        name: judge(candidates(of, learnt, screen) if first[name] else [], least)
        for name, of in observed.items()
    }
    return verdicts, learnt


def _without_rivals(
    verdicts: Mapping[str, NameVerdict], times: Mapping[str, Sequence[Times]]
) -> dict[str, NameVerdict]:
    """Return the verdicts; objects that were seen at one time are not one satellite.

    An object may be seen again after a gap without being recognised: two that were seen at
    different times may have one name.
    """
    named: dict[int, list[str]] = {}
    for name, verdict in verdicts.items():
        if (satellite := _satellite(verdict)) is not None:
            named.setdefault(satellite, []).append(name)
    rivals = {
        name
        for names in named.values()
        for name in names
        for other in names
        if other != name and _overlap(times[name], times[other])
    }
    return {
        name: verdict._replace(status="ambiguous") if name in rivals else verdict
        for name, verdict in verdicts.items()
    }


def _overlap(one: Sequence[Times], other: Sequence[Times]) -> bool:
    return any(a[0] <= b[1] and b[0] <= a[1] for a in one for b in other)


def _status(verdicts: Mapping[str, NameVerdict], name: str) -> str:
    return verdicts[name].status if name in verdicts else "unknown"


def _rows(
    objects: Sequence[str],
    verdicts: Mapping[str, NameVerdict],
    known: ElementsOfNight | None,
) -> pa.Table:
    """Return IDENTIFICATIONS: a row per object, in order of their ids."""
    sets = known.sets if known is not None else []
    of = [verdicts.get(name) for name in objects]
    names = [
        names_of(v.status, sets, v.best.row, v.rows) if v and v.best else CatalogueNames()
        for v in of
    ]
    best = [verdict.best if verdict is not None else None for verdict in of]
    columns = {
        "object_id": list(objects),
        "tracklet_id": [None] * len(objects),
        "status": [_status(verdicts, name) for name in objects],
        "distance_km": [each.distance_km if each else None for each in best],
        "mahalanobis": [each.mahalanobis if each else None for each in best],
        "probability": [verdict.probability if verdict else None for verdict in of],
    }
    return identification_rows(columns, names, known)

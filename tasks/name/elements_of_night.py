"""Element sets of a night: the best one of each object of a catalogue, and its names."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow as pa

from epipole.io.catalogues.element_sets import KnownObjects
from epipole.schemas.bridge import concat, table
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.spans import DAY_NS
from epipole.schemas.star_lists import ElementSet, nearest_sets
from epipole.schemas.tables import IDENTIFICATIONS, REJECTS
from epipole.tasks.algorithms.known_objects.prediction import predict, satellites_of


class ElementsOfNight(NamedTuple):
    """The element sets of a catalogue that are used in a night, each of another object."""

    sha256: str
    sets: list[ElementSet]

    @property
    def elements(self) -> np.ndarray:
        """Mean elements, (n, 10); see `ElementSet`."""
        return np.array([each.elements for each in self.sets]).reshape(-1, 10)


def elements_of_night(
    known: KnownObjects, night: str, max_days: float
) -> tuple[ElementsOfNight, pa.Table]:
    """Return the elements that are used in a night, and `rejects` of those that are not.

    Of each object it is the set whose epoch is nearest to the middle of the night.
    """
    middle_ns = int(np.datetime64(night, "ns").astype(np.int64)) + DAY_NS // 2
    max_ns = max_days * DAY_NS
    nearest = nearest_sets(known.sets, middle_ns)
    recent = [each for each in nearest if abs(each.epoch_ns - middle_ns) <= max_ns]
    made = ElementsOfNight(known.sha256, recent)
    states = predict(satellites_of(made.elements), np.array([middle_ns]))
    sound = np.atleast_1d(np.isfinite(states[:, 0]).all(axis=1))
    used = [each for each, is_sound in zip(recent, sound, strict=True) if is_sound]
    counts = {
        Reason.BAD_ELEMENTS: len(known.faults),
        Reason.OTHER_ELEMENTS: len(known.sets) - len(nearest),
        Reason.OLD_ELEMENTS: len(nearest) - len(recent),
        Reason.FAILED_ELEMENTS: len(recent) - len(used),
    }
    rejects = [
        reject_rows(reason, source=known.file, time=[middle_ns - DAY_NS // 2], count=[count])
        for reason, count in counts.items()
        if count
    ]
    return made._replace(sets=used), concat(REJECTS, rejects)


class CatalogueNames(NamedTuple):
    """The columns of `identifications` that are what the catalogue says."""

    norad_id: int | None = None
    cospar_id: str | None = None
    name: str | None = None
    element_epoch: int | None = None


def names_of(
    status: str, sets: Sequence[ElementSet], best: int, rows: Sequence[int]
) -> CatalogueNames:
    """Return the columns of the catalogue for an object or a tracklet.

    Parameters
    ----------
    status
        A `NameStatus`.
    best
        The likeliest of the sets, or the nearest one of something unknown.
    rows
        All sets that something ambiguous may be.
    """
    of = sets[best]
    if status == "known":
        return CatalogueNames(of.number, of.cospar_id or None, of.name or None, of.epoch_ns)
    if status == "ambiguous":
        names = " / ".join(sets[row].name or str(sets[row].number) for row in rows)
        return CatalogueNames(name=names, element_epoch=of.epoch_ns)
    return CatalogueNames(element_epoch=of.epoch_ns)


def identification_rows(
    columns: Mapping[str, Any], names: Sequence[CatalogueNames], known: ElementsOfNight | None
) -> pa.Table:
    """Return IDENTIFICATIONS of objects or tracklets, not yet compared with earlier nights."""
    of_catalogue = {
        field: [getattr(each, field) for each in names] for field in CatalogueNames._fields
    }
    sha256 = known.sha256 if known is not None else None
    rest = {"same_as": [None] * len(names), "catalogue": [sha256] * len(names)}
    return table(IDENTIFICATIONS, {**columns, **of_catalogue, **rest})

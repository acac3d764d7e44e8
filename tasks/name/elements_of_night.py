"""Elements of a night: one usable element set for each object of a catalogue."""

from typing import NamedTuple

import numpy as np
import pyarrow as pa

from epipole.io.catalogues.known_objects import KnownObjects
from epipole.schemas.bridge import concat
from epipole.schemas.catalogues.element_set import ElementSet, nearest_sets
from epipole.schemas.rejects import Reason, reject_rows
from epipole.schemas.settings import Settings
from epipole.schemas.spans import DAY_NS
from epipole.schemas.tables import REJECTS
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
    known: KnownObjects, night: str, settings: Settings
) -> tuple[ElementsOfNight, pa.Table]:
    """Return the elements that are used in a night, and `rejects` of those that are not.

    Of each object it is the set whose epoch is nearest to the middle of the night.
    """
    middle_ns = int(np.datetime64(night, "ns").astype(np.int64)) + DAY_NS // 2
    most_ns = settings.known_objects.most_days * DAY_NS
    nearest = nearest_sets(known.sets, middle_ns)
    recent = [each for each in nearest if abs(each.epoch_ns - middle_ns) <= most_ns]
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

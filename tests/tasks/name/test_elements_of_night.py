"""Elements of a night: the nearest set of each object; what is left out has a row in `rejects`."""

import numpy as np
from scenes.satellites import ISS
from scenes.walker import DAY_NS, NIGHT_NS, satellites

from epipole.io.catalogues.element_sets import Fault, KnownObjects
from epipole.schemas.settings import KnownObjectSettings, Settings
from epipole.tasks.name.elements_of_night import elements_of_night

NIGHT = "2026-05-30"


def used(sets, faults=(), days=30.0):
    known = KnownObjects("a.tle", "digest", list(sets), list(faults))
    settings = Settings(known_objects=KnownObjectSettings(max_days=days))
    made, rejects = elements_of_night(known, NIGHT, settings.known_objects.max_days)
    counts = dict(zip(rejects["reason"].to_pylist(), rejects["count"].to_pylist(), strict=True))
    assert set(rejects["source"].to_pylist()) <= {"a.tle"}
    return made, counts


def later(each, days):
    """The same elements at another epoch."""
    elements = (each.elements[0] + days, *each.elements[1:])
    return each._replace(epoch_ns=each.epoch_ns + round(days * DAY_NS), elements=elements)


def test_of_each_object_the_set_nearest_to_the_night_is_used():
    one, two = satellites(2, np.random.default_rng(1))
    made, counts = used([later(one, -3), one, later(one, 4), later(two, -2)])
    assert made.sets == [one, later(two, -2)]
    assert made.sha256 == "digest"
    assert counts == {"other_elements": 2}


def test_old_and_failing_and_invalid_ones_are_left_out_and_counted():
    (one,) = satellites(1, np.random.default_rng(1))
    down = ISS._replace(number=2, epoch_ns=NIGHT_NS - 20 * DAY_NS)
    down = down._replace(elements=(down.elements[0] - 20, 0.5, *down.elements[2:]))
    old = later(ISS._replace(number=3), -366)
    made, counts = used([one, down, old], faults=[Fault("line 1", "is bad")])
    assert made.sets == [one]
    assert counts == {"bad_elements": 1, "old_elements": 1, "failed_elements": 1}


def test_a_catalogue_may_have_nothing_for_a_night():
    made, counts = used([later(ISS, -366)])
    assert made.sets == []
    assert made.elements.shape == (0, 10)
    assert counts == {"old_elements": 1}

"""Objects of a night: counts over both tables, verdicts in their order, brightness, names."""

import numpy as np
import pytest
from scenes.made_nights import START_NS, filled, reader_of, seconds

from epipole.schemas.rejects import Found, ObjectVerdict
from epipole.tasks.publish.night_objects import objects_of

MILLION = 1_000_000


def observed(name, n=4, **columns):
    """Observations of an object, one a second, by turns of two sensors."""
    given = {"time": seconds(n), "sensor_id": (["a", "b"] * n)[:n], "tracklet_id": ["t"] * n,
             "blended": [False] * n}  # fmt: skip
    reduced = {"magnitude_1000_km": columns["magnitude"]} if "magnitude" in columns else {}
    return {"object_id": [name] * n, **given, **columns, **reduced}


def solved(name, n=4, n_sensors=2, **columns):
    given = {"time": seconds(n), "n_sensors": [n_sensors] * n, "independent": [True] * n}
    return {"object_id": [name] * n, **given, **columns}


def rows(table, each):
    """Return all these rows; missing columns are those of `filled`."""
    names = {name for columns in each for name in columns}
    blank = {"chi2": 0.0, "n_rejected": 0}
    return filled(table, **{
        name: [v for of in each for v in of.get(name, [blank.get(name)] * len(of["time"]))]
        for name in names
    })  # fmt: skip


def found(seen=(), positions=(), orbits=(), verdicts=None, in_group=1000, **tables):
    """Return the objects by their ids; tables are read in groups of so many rows."""
    made = {"orbits": filled("orbits", object_id=list(orbits))} if orbits else {}
    made |= {"observations": rows("observations", seen)} if seen else {}
    made |= {"positions": rows("positions", positions)} if positions else {}
    table = objects_of(reader_of(made | tables, in_group=in_group), verdicts or {})
    return {row["object_id"]: row for row in table.to_pylist()}


def test_an_object_has_the_counts_of_its_observations_and_positions():
    seen = [observed("o", 5, tracklet_id=["t", "u", None, "t", "t"]), observed("p", 3)]
    each = found(seen, [solved("o", 2, time=seconds(2) - MILLION)], ["o", "p"], in_group=2)
    assert list(each) == ["o", "p"]
    o = each["o"]
    assert (o["n_sensors"], o["n_tracklets"], o["n_observations"], o["n_positions"]) == (2, 2, 5, 2)
    assert (o["found"], each["p"]["found"]) == (Found.TOGETHER, Found.LINKED)
    assert (o["verdict"], each["p"]["verdict"]) == (ObjectVerdict.SOUND,) * 2
    # The first is a position, the last an observation.
    times = [o[name].timestamp() * 1e9 for name in ("first_time", "last_time")]
    assert times == pytest.approx([START_NS - MILLION, START_NS + 4 * 10**9], abs=1000)


def test_a_position_whose_detections_are_of_another_night_is_an_object():
    each = found(positions=[solved("o")])
    assert (each["o"]["n_observations"], each["o"]["n_sensors"]) == (0, 0)
    assert each["o"]["verdict"] == ObjectVerdict.NO_ORBIT


WORSE = [30.0] * 4  # of one degree of freedom: 1 in 20 million


@pytest.mark.parametrize(
    ("seen", "positions", "misfit", "verdict"),
    [
        ({}, {}, False, ObjectVerdict.SOUND),
        ({}, {}, True, ObjectVerdict.ORBIT_MISFIT),
        ({}, {"chi2": WORSE}, True, ObjectVerdict.TWO_SENSORS_DISAGREE),
        ({}, {"chi2": WORSE, "independent": [False] * 4}, True, ObjectVerdict.ORBIT_MISFIT),
        ({}, {"chi2": WORSE, "n_sensors": 3}, False, ObjectVerdict.SOUND),
        ({}, {"chi2": [50.0] * 4, "n_sensors": 3}, False, ObjectVerdict.SENSORS_DISAGREE),
        ({}, {"n_sensors": 3, "n_rejected": [1, 1, 1, 0]}, True, ObjectVerdict.SENSORS_DISAGREE),
        ({}, {"n_sensors": 3, "n_rejected": [1, 1, 0, 0]}, True, ObjectVerdict.ORBIT_MISFIT),
        ({"blended": [True] * 3 + [False]}, {"chi2": WORSE}, True, ObjectVerdict.BLENDED),
        ({"blended": [True, False] * 2}, {}, False, ObjectVerdict.SOUND),
    ],
)
def test_the_first_verdict_that_is_true_counts(seen, positions, misfit, verdict):
    of_orbits = {"o": ObjectVerdict.ORBIT_MISFIT} if misfit else {}
    orbits = [] if misfit else ["o"]
    each = found([observed("o", **seen)], [solved("o", **positions)], orbits, of_orbits)
    assert each["o"]["verdict"] == verdict


def test_an_object_that_changed_its_orbit_has_one_and_says_so():
    changed = {"o": ObjectVerdict.MANOEUVRED}
    each = found([observed("o"), observed("p")], [], ["o", "p"], changed)
    assert each["o"]["verdict"] == ObjectVerdict.MANOEUVRED
    assert each["p"]["verdict"] == ObjectVerdict.SOUND


def test_in_a_night_in_doubt_objects_with_positions_are_in_doubt():
    checks = filled("checks", sensor_id=["a"], check=["sensors_agree"], verdict=["wrong"])
    each = found([observed("o"), observed("p")], [solved("o")], ["o", "p"], checks=checks)
    assert each["o"]["verdict"] == ObjectVerdict.SENSORS_IN_DOUBT
    assert each["p"]["verdict"] == ObjectVerdict.SOUND


def test_the_amplitude_is_that_of_the_light_curve_beyond_its_noise():
    n, noise = 4000, 0.2
    rng = np.random.default_rng(1)
    turning = 9.0 + 0.5 * np.sin(np.arange(n) / 7.0)
    seen = [
        observed(name, n, magnitude=list(curve + noise * rng.normal(size=n)),
                 magnitude_sigma=[noise] * n)
        for name, curve in (("turning", turning), ("steady", np.full(n, 9.0)))
    ]  # fmt: skip
    each = found(seen, in_group=900)
    assert each["turning"]["magnitude"] == pytest.approx(9.0, abs=0.03)
    assert each["turning"]["magnitude_amplitude"] == pytest.approx(1.0, abs=0.05)
    assert each["steady"]["magnitude_amplitude"] < 0.15


def test_magnitudes_of_blended_detections_do_not_count():
    bright = {"magnitude": [5.0, 9.0, None, 9.0], "magnitude_sigma": [0.1, 0.1, None, 0.1]}
    seen = [
        observed("o", **bright, blended=[True, False, False, False]), observed("dark"),
        observed("once", 1, magnitude=[7.0], magnitude_sigma=[0.1]),
    ]  # fmt: skip
    each = found(seen)
    of = {name: (row["magnitude"], row["magnitude_amplitude"]) for name, row in each.items()}
    assert of == {"o": (9.0, 0.0), "dark": (None, None), "once": (7.0, None)}


def test_without_a_range_the_amplitude_is_not_known():
    bright = {"magnitude": [8.0, 9.0], "magnitude_sigma": [0.1, 0.1]}
    (each,) = found([observed("o", 2, **bright) | {"magnitude_1000_km": [None, 9.0]}]).values()
    assert (each["magnitude"], each["magnitude_amplitude"]) == (8.5, None)


def test_only_known_objects_have_a_name():
    named = filled(
        "identifications", object_id=["o", "p", None], status=["known", "ambiguous", "known"],
        norad_id=[7, None, 8], cospar_id=["2020-001A", None, None], name=["SAT 7", "A / B", "C"],
    )  # fmt: skip
    each = found([observed("o"), observed("p")], identifications=named)
    assert [each["o"][key] for key in ("norad_id", "cospar_id", "name")] == [
        7,
        "2020-001A",
        "SAT 7",
    ]
    assert [each["p"][key] for key in ("norad_id", "cospar_id", "name")] == [None] * 3


def test_a_night_without_objects_has_no_rows():
    assert found() == {}
    assert found([observed(None)]) == {}

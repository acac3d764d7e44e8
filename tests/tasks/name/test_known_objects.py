"""The table `identifications` of a night: names, rivals, and objects of earlier nights."""

import numpy as np
import polars as pl
import pyarrow as pa
import pytest
from scenes.associations import filled
from scenes.seen_tracklets import as_table, seen_from_near
from scenes.walker import NIGHT_NS, satellites

from epipole.io.datasets.night_tables import PART, write_table
from epipole.schemas.columns import POSITION, STATE_AXES, VELOCITY, upper_triangle
from epipole.schemas.settings import KnownObjectSettings, Settings
from epipole.schemas.tables import OBSERVATIONS, ORBITS, POSITIONS, STATES, TRACKLETS
from epipole.tasks.algorithms.known_objects.prediction import predict, satellites_of
from epipole.tasks.name.earlier_objects import EarlierObjects
from epipole.tasks.name.elements_of_night import ElementsOfNight
from epipole.tasks.name.known_objects import name_known_objects

SIGMA_KM = 0.1
DAY_NS = 86_400_000_000_000


def path(each, times):
    """States along an orbit; velocities are derivatives, for SGP4's own lack some terms."""
    satellite = satellites_of(np.array([each.elements]))
    at, before, after = (predict(satellite, times + dt)[0] for dt in (0, -(10**8), 10**8))
    at[:, 3:] = (after - before)[:, :3] / 0.2
    return at


def seconds(start_s, count=6, step_s=20.0):
    return NIGHT_NS + ((start_s + step_s * np.arange(count)) * 1e9).astype(np.int64)


def positions(rng, seen):
    """Positions of objects: name -> (elements, times)."""
    parts = [pl.DataFrame(filled(POSITIONS, 0, {}))]
    for name, (each, times) in seen.items():
        r_km = path(each, times)[:, :3] + rng.normal(0, SIGMA_KM, (len(times), 3))
        rows = {"epoch": times, "time": times, "object_id": [name] * len(times)}
        rows |= dict(zip(POSITION, r_km.T, strict=True))
        rows |= {f"cov_{a}{a}": np.full(len(times), SIGMA_KM**2) for a in "xyz"}
        parts.append(pl.DataFrame(filled(POSITIONS, len(times), rows)))
    return pl.concat(parts).sort("epoch").to_arrow().cast(POSITIONS)


def observations(seen, sensors):
    """Directions to objects from resting sensors, each (name, place, how late its clock is [s])."""
    parts = [pl.DataFrame(filled(OBSERVATIONS, 0, {}))]
    for name, (each, times) in seen.items():
        for sensor, place, late_s in sensors:
            state = path(each, times - round(late_s * 1e9))
            apart = state[:, :3] - place
            delay = np.linalg.norm(apart, axis=1, keepdims=True) / 299792.458
            apart = apart - delay * state[:, 3:]
            ra = np.degrees(np.arctan2(apart[:, 1], apart[:, 0]))
            dec = np.degrees(np.arcsin(apart[:, 2] / np.linalg.norm(apart, axis=1)))
            rows = {"time": times, "object_id": [name] * len(times), "ra_deg": ra, "dec_deg": dec,
                    "sensor_id": [sensor] * len(times)}  # fmt: skip
            rows |= {k: np.full(len(times), v) for k, v in zip(POSITION, place, strict=True)}
            parts.append(pl.DataFrame(filled(OBSERVATIONS, len(times), rows)))
    return pl.concat(parts).to_arrow().cast(OBSERVATIONS)


def states(seen, sigma_km=0.05, sigma_km_s=1e-5, schema=STATES, **columns):
    """One state, or orbit, of each object, at its first time."""
    variance = np.diag([sigma_km**2] * 3 + [sigma_km_s**2] * 3)
    rows = {"epoch": [], "object_id": []} | {name: [] for name in (*POSITION, *VELOCITY)}
    for name, (each, times) in seen.items():
        rows["epoch"].append(times[0])
        rows["object_id"].append(name)
        for column, value in zip((*POSITION, *VELOCITY), path(each, times[:1])[0], strict=True):
            rows[column].append(value)
    for (a, b), (i, j) in zip(
        upper_triangle(STATE_AXES), zip(*np.triu_indices(6), strict=True), strict=True
    ):
        rows[f"cov_{a}{b}"] = [variance[i, j]] * len(seen)
    return filled(schema, len(seen), rows | columns)


def orbits(seen, sigma_km=0.05, sigma_km_s=1e-4):
    """One orbit of each object, of ten minutes about its first time."""
    n = len(seen)
    return states(seen, sigma_km, sigma_km_s, ORBITS, arc_s=[600.0] * n,
                  forces=["GM J2-J4 C22 Sun Moon"] * n)  # fmt: skip


@pytest.fixture
def named(tmp_path):
    """Return a function that names the objects of a night, and returns the table's rows."""

    def name(seen, known, *, earlier=None, earlier_orbits=None, sensors=(), settings=None,
             tracklets=None, unsolved=()):  # fmt: skip
        solved = {name: of for name, of in seen.items() if name not in unsolved}
        tables = {"positions": positions(np.random.default_rng(1), solved),
                  "states": states(solved),
                  "orbits": orbits(seen) if earlier_orbits else ORBITS.empty_table(),
                  "observations": observations(seen, sensors),
                  "tracklets": tracklets or TRACKLETS.empty_table()}  # fmt: skip
        for table, rows in tables.items():
            write_table(tmp_path, table, [rows])
        before = EarlierObjects(
            states(earlier) if earlier else STATES.empty_table(),
            ORBITS.empty_table() if earlier_orbits is None else earlier_orbits,
        )
        settings = settings or Settings()
        residuals = name_known_objects.fn(
            tmp_path, known, before, settings.known_objects, settings.states.link_log_odds
        )
        return pl.read_parquet(tmp_path / "identifications" / PART), residuals

    return name


@pytest.fixture(scope="module")
def fleet():
    return satellites(30, np.random.default_rng(20))


def test_each_object_has_a_row_with_its_name(named, fleet):
    seen = {f"o{k:02d}": (fleet[k], seconds(3600 * k)) for k in range(12)}
    rows, _ = named(seen, ElementsOfNight("digest", fleet[:8]))
    assert rows["object_id"].to_list() == sorted(seen)
    assert rows["status"].to_list() == ["known"] * 8 + ["unknown"] * 4
    assert rows["norad_id"].to_list() == [100_000 + k for k in range(8)] + [None] * 4
    assert rows["name"].to_list()[:9] == [f"SAT {k}" for k in range(8)] + [None]
    assert rows["cospar_id"][3] == "2020-003A"
    assert (rows["probability"] > 0.99).all()
    assert (rows["catalogue"] == "digest").all()
    assert rows["distance_km"].to_numpy()[:8].max() < 1.0
    assert rows["element_epoch"].cast(pl.Int64)[2] == fleet[2].epoch_ns


def test_without_a_catalogue_all_objects_are_unknown(named, fleet):
    rows, residuals = named({"o": (fleet[0], seconds(10))}, None)
    assert rows["status"].to_list() == ["unknown"]
    assert rows["probability"].to_list() == [None]
    assert rows["catalogue"].to_list() == [None]
    assert residuals == []


def test_a_night_without_objects_has_no_rows(named, fleet):
    rows, residuals = named({}, ElementsOfNight("digest", fleet))
    assert len(rows) == 0
    assert residuals == []


def test_two_objects_at_one_time_are_not_one_satellite(named, fleet):
    seen = {"a": (fleet[0], seconds(10)), "b": (fleet[0], seconds(20))}
    rows, _ = named(seen, ElementsOfNight("digest", fleet))
    assert rows["status"].to_list() == ["ambiguous", "ambiguous"]
    assert rows["norad_id"].to_list() == [None, None]
    assert rows["name"].to_list() == ["SAT 0", "SAT 0"]


def test_one_satellite_that_is_seen_twice_has_its_name_twice(named, fleet):
    seen = {"a": (fleet[0], seconds(10)), "b": (fleet[0], seconds(40_000))}
    rows, _ = named(seen, ElementsOfNight("digest", fleet))
    assert rows["norad_id"].to_list() == [100_000, 100_000]
    # Also between two times of the first one.
    seen["a"] = (fleet[0], np.concatenate([seconds(10), seconds(60_000)]))
    rows, _ = named(seen, ElementsOfNight("digest", fleet))
    assert rows["norad_id"].to_list() == [100_000, 100_000]


def test_an_unknown_object_is_recognised_as_one_of_an_earlier_night(named, fleet):
    high = [each for each in fleet if each.elements[8] < 0.01][:3]
    before = {f"old{k}": (each, seconds(-20_000)) for k, each in enumerate(high)}
    seen = {f"new{k}": (each, seconds(1000)) for k, each in enumerate(high[1:], start=1)}
    rows, _ = named(seen, None, earlier=before)
    assert rows["same_as"].to_list() == ["old1", "old2"]
    off = Settings(known_objects=KnownObjectSettings(earlier_h=0.0))
    rows, _ = named(seen, None, earlier=before, settings=off)
    assert rows["same_as"].to_list() == [None, None]


def test_objects_that_have_only_orbits_are_recognised_a_day_later(named, fleet):
    low = [each for each in fleet if each.elements[8] > 0.04][:8]
    before = orbits({f"old{k}": (each, seconds(-70_000)) for k, each in enumerate(low)})
    seen = {f"new{k}": (each, seconds(9000)) for k, each in enumerate(low[2:], start=2)}
    solved_by_none = {"sensors": [("a", np.zeros(3), 0.0)], "unsolved": list(seen)}
    rows, _ = named(seen, None, earlier_orbits=before, **solved_by_none)
    assert rows["same_as"].to_list() == [f"old{k}" for k in range(2, 8)]
    # Of two that may be the same, none.
    twin = before.slice(2, 1).set_column(
        before.schema.get_field_index("object_id"), "object_id", [pa.array(["twin"])]
    )
    both = pa.concat_tables([before, twin.cast(before.schema)])
    rows, _ = named(seen, None, earlier_orbits=both, **solved_by_none)
    assert rows["same_as"].to_list() == [None, *(f"old{k}" for k in range(3, 8))]


def test_an_object_of_two_earlier_nights_is_recognised_by_its_later_id(named, fleet):
    low = [each for each in fleet if each.elements[8] > 0.04][:8]
    first = orbits({f"first{k}": (each, seconds(-110_000)) for k, each in enumerate(low)})
    second = orbits({f"second{k}": (each, seconds(-60_000)) for k, each in enumerate(low)})
    seen = {f"new{k}": (each, seconds(9000)) for k, each in enumerate(low)}
    rows, _ = named(seen, None, earlier_orbits=pa.concat_tables([first, second]),
                    sensors=[("a", np.zeros(3), 0.0)], unsolved=list(seen))  # fmt: skip
    assert rows["same_as"].to_list() == [f"second{k}" for k in range(8)]


def test_an_object_with_two_ids_in_a_night_is_recognised_by_both(named, fleet):
    low = [each for each in fleet if each.elements[8] > 0.04][:8]
    before = orbits({f"old{k}": (each, seconds(-70_000)) for k, each in enumerate(low[:7])})
    seen = {f"a{k}": (each, seconds(9000)) for k, each in enumerate(low)}
    seen |= {f"b{k}": (each, seconds(30_000)) for k, each in enumerate(low)}
    rows, _ = named(seen, None, earlier_orbits=before, sensors=[("a", np.zeros(3), 0.0)],
                    unsolved=list(seen))  # fmt: skip
    ids = [*(f"old{k}" for k in range(7)), None]
    assert rows["same_as"].to_list() == [*ids, *ids]


def test_vague_orbits_recognise_no_objects(named, fleet):
    low = [each for each in fleet if each.elements[8] > 0.04][:3]
    before = {f"old{k}": (each, seconds(-70_000)) for k, each in enumerate(low)}
    seen = {f"new{k}": (each, seconds(9000)) for k, each in enumerate(low)}
    rows, _ = named(seen, None, earlier_orbits=orbits(before, sigma_km=200.0),
                    sensors=[("a", np.zeros(3), 0.0)], unsolved=list(seen))  # fmt: skip
    assert rows["same_as"].to_list() == [None] * 3


def test_known_objects_and_those_that_kept_their_id_are_not_asked(named, fleet):
    high = [each for each in fleet if each.elements[8] < 0.01][:2]
    before = {"old": (high[0], seconds(-20_000)), "kept": (high[1], seconds(-20_000))}
    seen = {"new": (high[0], seconds(1000)), "kept": (high[1], seconds(1000))}
    rows, _ = named(seen, ElementsOfNight("digest", high[:1]), earlier=before)
    assert rows["status"].to_list() == ["unknown", "known"]
    assert rows["same_as"].to_list() == [None, None]


def test_a_late_clock_shows_in_the_residuals_of_its_sensor(named, fleet):
    low = [each for each in fleet if each.elements[8] > 0.04][:10]
    seen = {f"o{k}": (each, seconds(2000 * k)) for k, each in enumerate(low)}
    sensors = [("a", np.zeros(3), 0.0), ("b", np.zeros(3), 0.5)]
    _, residuals = named(seen, ElementsOfNight("digest", low), sensors=sensors)
    sound, late = residuals
    assert (sound.sensor_id, sound.objects) == ("a", len(low))
    assert abs(sound.along_km) < 0.01
    assert late.along_km == pytest.approx(-3.7, abs=0.2)  # half a second of 7.4 km/s
    assert abs(late.across_km) < 0.05
    assert "b: along -3." in str(late)


def test_tracklets_without_object_have_rows_of_their_own(named, fleet):
    rng = np.random.default_rng(4)
    seen, rows = seen_from_near(fleet, 40, rng)
    ids = [f"t{k:02d}" for k in range(40)]
    made = as_table(seen, ids, object_id=[*["o"] * 3, *[None] * 37])
    found, _ = named({"o": (fleet[0], seconds(10))}, ElementsOfNight("digest", fleet[:20]),
                     tracklets=made)  # fmt: skip
    assert found["object_id"].to_list() == ["o", *[None] * 37]
    assert found["tracklet_id"].to_list() == [None, *ids[3:]]
    of = found.filter(pl.col("tracklet_id").is_not_null())
    expected = [100_000 + k if k < 20 else None for k in rows[3:].tolist()]
    assert of["norad_id"].to_list() == expected
    assert of["status"].to_list() == ["unknown" if n is None else "known" for n in expected]
    assert (of["catalogue"] == "digest").all()
    assert of.filter(status="known")["distance_km"].max() < 1.0


def test_objects_without_positions_are_named_by_their_tracklets(named, fleet):
    seen, rows = seen_from_near(fleet, 40, np.random.default_rng(4))
    ids, of = [f"t{k:02d}" for k in range(40)], [f"x{k:02d}" for k in rows.tolist()]
    made = as_table(seen, ids, object_id=of)
    found, _ = named({}, ElementsOfNight("digest", fleet[:20]), tracklets=made)
    assert found["object_id"].to_list() == sorted(set(of))
    assert found["tracklet_id"].null_count() == len(found)
    for name, status, number in found.select("object_id", "status", "norad_id").iter_rows():
        row = int(name[1:])
        assert (status, number) == (("known", 100_000 + row) if row < 20 else ("unknown", None))


def test_a_satellite_that_does_not_fit_all_tracklets_of_an_object_is_not_it(named, fleet):
    seen, rows = seen_from_near(fleet, 40, np.random.default_rng(4))
    (one,), other = np.flatnonzero(rows == rows[0])[:1], np.flatnonzero(rows != rows[0])[0]
    mixed = type(seen)(*(column[[one, other]] for column in seen))
    found, _ = named({}, ElementsOfNight("digest", fleet),
                     tracklets=as_table(mixed, ["t0", "t1"], object_id=["x", "x"]))  # fmt: skip
    assert found["status"].to_list() == ["unknown"]
    assert found["norad_id"].to_list() == [None]


def test_an_object_that_has_only_observations_has_a_row(named, fleet):
    seen = {"o": (fleet[0], seconds(10)), "p": (fleet[1], seconds(10))}
    for known, status in ((None, "unknown"), (ElementsOfNight("digest", fleet), "known")):
        rows, _ = named(seen, known, sensors=[("a", np.zeros(3), 0.0)], unsolved=["p"])
        assert rows["object_id"].to_list() == ["o", "p"]
        assert rows["status"].to_list() == [status, "unknown"]


def test_two_tracks_of_one_sensor_at_one_time_are_not_one_satellite(named, fleet):
    seen, _ = seen_from_near(fleet[:1], 1, np.random.default_rng(5))
    twice = type(seen)(*(np.concatenate([column, column]) for column in seen))
    for tracks, status in ((["a", "b"], "ambiguous"), (["a", "a"], "known")):
        made = as_table(twice, ["t1", "t2"], track_id=tracks)
        found, _ = named({}, ElementsOfNight("digest", fleet), tracklets=made)
        assert found["status"].to_list() == [status] * 2
    assert found["name"].to_list() == ["SAT 0"] * 2


@pytest.mark.parametrize(
    ("of_sensor", "later_s", "status"),
    [("sat0", 0.0, "ambiguous"), ("sat0", 5.0, "known"), ("sat1", 0.0, "known")],
)
def test_a_tracklet_beside_one_of_a_named_object_is_not_the_same_satellite(
    named, fleet, of_sensor, later_s, status
):
    seen, _ = seen_from_near(fleet[:1], 1, np.random.default_rng(5))
    twice = type(seen)(*(np.concatenate([column, column]) for column in seen))
    shift = np.array([round(later_s * 1e9), 0])
    made = as_table(
        twice, ["t1", "t2"], object_id=["o", None], sensor_id=[of_sensor, "sat0"],
        start_time=twice.time_ns + shift - 10**9, end_time=twice.time_ns + shift + 10**9,
    )  # fmt: skip
    at = (int(seen.time_ns[0]) - NIGHT_NS) / 1e9
    rows, _ = named(
        {"o": (fleet[0], seconds(at))}, ElementsOfNight("digest", fleet), tracklets=made
    )
    assert rows["status"].to_list() == ["known", status]


def test_without_a_catalogue_tracklets_have_no_rows(named, fleet):
    seen, _ = seen_from_near(fleet, 3, np.random.default_rng(6))
    rows, _ = named({}, None, tracklets=as_table(seen, ["t1", "t2", "t3"]))
    assert not len(rows)


def test_a_tracklet_without_direction_is_unknown(named, fleet):
    seen, _ = seen_from_near(fleet, 2, np.random.default_rng(7))
    made = as_table(seen, ["t1", "t2"], ra_deg=[None, 1.0], epoch=[None, NIGHT_NS])
    rows, _ = named({}, ElementsOfNight("digest", fleet), tracklets=made)
    assert rows["status"].to_list() == ["unknown"] * 2
    assert rows["distance_km"].null_count() == 2

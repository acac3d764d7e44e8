"""Ephemerides of objects: through the arc, exact at the epoch, covariances that grow with it."""

import numpy as np
import polars as pl
import pytest
from scenes.little_night import little_state, rows
from scenes.night_orbits import AROUND, GEO, LOW, NOON_NS, positions

from epipole.io.ccsds import Subject
from epipole.schemas.bridge import to_polars
from epipole.schemas.columns import POSITION, STATE_AXES, VELOCITY
from epipole.schemas.tables import IDENTIFICATIONS, ORBITS, POSITIONS, STATES
from epipole.tasks.algorithms.constants import EARTH_RADIUS_KM, GM_KM3_S2
from epipole.tasks.common.orbit_forces import areas_in
from epipole.tasks.export import (
    HALF_ARC_S,
    arcs,
    orbit_arc,
    positive,
    single_states,
    subjects,
)


def tables(*since_s: float) -> tuple[pl.DataFrame, pl.DataFrame]:
    """A state of the little night's object, and positions so many seconds after it."""
    states = to_polars(rows(STATES, little_state("o1", cov_xy=0.1)))
    places = to_polars(rows(POSITIONS, *[{"object_id": "o1"} for _ in since_s] or [{}]))
    epoch = states["epoch"][0]
    at = [epoch + pl.duration(microseconds=round(s * 1e6)) for s in since_s]
    return states, places.head(len(since_s)).with_columns(
        epoch=pl.concat_list(at).explode() if at else pl.col("epoch")
    )


def test_an_arc_covers_the_positions_about_its_epoch():
    states, places = tables(-100.0, -3.0, 0.0, 250.0, 290.0, HALF_ARC_S + 5)
    (arc,) = arcs(states, places)
    epoch_ns = states["epoch"].dt.epoch("ns")[0]
    assert np.all(np.diff(arc.time_ns) > 0)
    assert [(t - epoch_ns) / 1e9 for t in arc.time_ns[[0, -1]]] == [-100.0, 290.0]
    assert epoch_ns in arc.time_ns


def test_the_state_itself_is_in_it_and_its_covariance():
    states, places = tables(-100.0, 100.0)
    (arc,), (alone,) = arcs(states, places), single_states(states)
    at = int(np.flatnonzero(arc.time_ns == alone.time_ns[0])[0])
    assert np.array_equal(arc.state[at], alone.state[0])
    assert arc.covariance_ns.tolist() == arc.time_ns.tolist()
    assert arc.covariance[at] == pytest.approx(alone.covariance[0])
    assert alone.covariance[0][0, 1] == alone.covariance[0][1, 0] == pytest.approx(0.1)


def test_positions_move_by_the_velocity_and_their_covariance_by_its_error():
    states, places = tables(-200.0, 200.0)
    (arc,) = arcs(states, places)
    epoch_ns = states["epoch"].dt.epoch("ns")[0]
    dt = (arc.time_ns[-1] - epoch_ns) / 1e9
    middle = arc.state[arc.time_ns == epoch_ns][0]
    straight = middle[:3] + middle[3:] * dt
    fall = 398600.4418 / middle[0] ** 2 * dt**2 / 2
    assert np.linalg.norm(arc.state[-1, :3] - straight) == pytest.approx(fall, rel=0.02)
    grown = arc.covariance[-1][2, 2]
    assert grown == pytest.approx(0.5**2 + (0.01 * dt) ** 2, rel=0.01)


def following(states, *since_s):
    """Return the state again at these seconds after it."""
    return pl.concat([
        states.with_columns(pl.col("epoch") + pl.duration(milliseconds=round(s * 1000)))
        for s in since_s
    ])  # fmt: skip


def test_each_position_is_covered_by_the_state_with_the_nearest_epoch():
    since_s = np.arange(-30.0, 91.0, 7.5)
    states, places = tables(*since_s)
    found = arcs(following(states, 60.0, 0.0), places)
    epoch_ns = states["epoch"].dt.epoch("ns")[0]
    spans = [[(t - epoch_ns) / 1e9 for t in arc.time_ns[[0, -1]]] for arc in found]
    assert spans == [[-30.0, 30.0], [37.5, 90.0]]


def test_a_state_covers_no_arc_that_has_none_beyond_five_minutes():
    states, places = tables(-5.0, 5.0, 200.0, HALF_ARC_S + 5.0)
    (arc, later) = arcs(following(states, 0.0, 800.0), places)
    epoch_ns = states["epoch"].dt.epoch("ns")[0]
    assert [(t - epoch_ns) / 1e9 for t in arc.time_ns[[0, -1]]] == [-5.0, 200.0]
    assert [(t - epoch_ns) / 1e9 for t in later.time_ns[[0, -1]]] == [799.0, 801.0]


def test_states_within_two_seconds_do_not_overlap():
    states, places = tables(0.0)
    before, after = arcs(following(states, 0.0, 0.0, 0.8), places)
    epoch_ns = states["epoch"].dt.epoch("ns")[0]
    assert [(t - epoch_ns) / 1e9 for t in before.time_ns[[0, -1]]] == pytest.approx([-1.0, 0.4])
    assert [(t - epoch_ns) / 1e9 for t in after.time_ns[[0, -1]]] == pytest.approx([0.4, 1.8])


def test_a_state_without_positions_is_two_seconds_long():
    (arc,) = arcs(*tables())
    assert arc.time_ns[-1] - arc.time_ns[0] == 2e9


def orbit(truth, arc_s, **other):
    """A row of ORBITS at noon of a true orbit of `night_orbits`, with a diagonal covariance."""
    R = AROUND.R_night_from_gcrf
    state = np.concatenate([R.T @ truth[:3], R.T @ truth[3:6]])
    cov = {f"cov_{a}{a}": v for a, v in zip(STATE_AXES, [0.04] * 3 + [1e-8] * 3, strict=True)}
    names = dict(zip([*POSITION, *VELOCITY], state, strict=True))
    (row,) = rows(ORBITS, {**names, **cov, "arc_s": arc_s, "forces": "GM"} | other).to_pylist()
    return row | {"epoch_ns": NOON_NS}


@pytest.mark.parametrize(("truth", "arc_s"), [(LOW, 7000.0), (GEO, 40_000.0), (LOW, 30.0)])
def test_an_orbit_is_moved_through_its_arc_by_its_forces(truth, arc_s):
    radiation = "GM J2-J4 C22 Sun Moon radiation 0.0300 m2/kg"
    row = orbit(truth, arc_s, forces=radiation if truth is GEO else "GM J2-J4 C22 Sun Moon")
    arc = orbit_arc(row, AROUND, NOON_NS)
    since_s = (arc.time_ns - NOON_NS) / 1e9
    assert (since_s[0], since_s[-1]) == (-arc_s / 2, arc_s / 2)
    assert np.diff(since_s).max() <= 120.0
    true_km = positions(truth, since_s) @ AROUND.R_night_from_gcrf
    assert np.abs(arc.state[:, :3] - true_km).max() < 1e-3
    assert arc.covariance_ns.tolist() == arc.time_ns.tolist()
    (at,) = np.flatnonzero(arc.time_ns == NOON_NS)
    np.testing.assert_allclose(arc.covariance[at], np.diag([0.04] * 3 + [1e-8] * 3))
    if arc_s < 100:  # free of forces: position and velocity
        grown = 0.04 + 1e-8 * (arc_s / 2) ** 2
        np.testing.assert_allclose(np.diag(arc.covariance[-1])[:3], grown, rtol=0.01)
    else:
        assert np.trace(arc.covariance[-1][:3, :3]) > 0.13


def test_an_orbit_goes_on_after_its_arc_when_asked():
    row = orbit(GEO, 600.0, forces="GM J2-J4 C22 Sun Moon radiation 0.0300 m2/kg")
    arc, ahead = (orbit_arc(row, AROUND, NOON_NS, ahead_s) for ahead_s in (0.0, 7200.0))
    assert ahead.time_ns[0] == arc.time_ns[0]
    since_s = (ahead.time_ns - NOON_NS) / 1e9
    assert since_s[-1] == 300.0 + 7200.0
    true_km = positions(GEO, since_s) @ AROUND.R_night_from_gcrf
    assert np.abs(ahead.state[:, :3] - true_km).max() < 1e-3
    assert np.trace(ahead.covariance[-1][:3, :3]) > 2 * np.trace(arc.covariance[-1][:3, :3])


def test_an_ephemeris_ends_where_the_object_comes_down():
    r_km = EARTH_RADIUS_KM + 150.0
    v_km_s = np.sqrt(GM_KM3_S2 / r_km) * np.array([0.0, 0.5, np.sqrt(0.75)])
    row = orbit(LOW, 600.0, forces="GM J2-J4 C22 Sun Moon drag 0.1000 m2/kg")
    row |= dict(zip([*POSITION, *VELOCITY], [r_km, 0.0, 0.0, *v_km_s], strict=True))
    arc = orbit_arc(row, AROUND, NOON_NS, 40_000.0)
    height_km = np.linalg.norm(arc.state[:, :3], axis=1) - EARTH_RADIUS_KM
    assert 60.0 < height_km[-1] < 110.0
    assert np.linalg.norm(arc.state[:, 3:], axis=1).max() < 8.5
    assert 600.0 < (arc.time_ns[-1] - NOON_NS) / 1e9 < 20_000.0
    assert np.isfinite(positive(arc.covariance)).all()


def test_areas_are_read_from_the_forces():
    assert areas_in("GM J2-J4 C22 Sun Moon") == [0.0, 0.0]
    assert areas_in("GM J2-J4 C22 Sun Moon radiation 0.0213 m2/kg") == [0.0213, 0.0]
    assert areas_in("GM J2-J4 C22 Sun Moon drag -0.0100 m2/kg") == [0.0, -0.01]


def test_only_known_names_are_given():
    named = rows(
        IDENTIFICATIONS,
        {"object_id": "o", "status": "known", "norad_id": 7, "name": "SAT"},
        {"tracklet_id": "t", "status": "known", "norad_id": 8, "cospar_id": "2020-001A"},
        {"object_id": "p", "status": "ambiguous", "name": "A / B"},
    )
    expected = {"o": Subject("o", 7, None, "SAT"), "t": Subject("t", 8, "2020-001A")}
    assert subjects(to_polars(named)) == expected


def test_covariances_are_positive_definite_after_a_day_of_a_weak_orbit():
    rng = np.random.default_rng(1)
    sound = np.array([a @ a.T for a in rng.normal(size=(5, 6, 6))])
    np.testing.assert_allclose(positive(sound), sound, rtol=1e-15)
    sigma = np.array([4e3, 2e3, 6e3, 1.0, 2.0, 3.0])
    weak = np.outer(sigma, sigma) * (1 - 1e-17)
    weak += np.diag(rng.normal(size=6) * 1e-12 * sigma**2)  # rounding
    (made,) = positive(weak[None])
    least = np.linalg.eigvalsh(made / np.sqrt(np.outer(np.diag(made), np.diag(made))))[0]
    assert least > 5e-11
    np.testing.assert_allclose(np.diag(made), np.diag(weak), rtol=1e-9)

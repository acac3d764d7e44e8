"""Object linking: recognised by motion, never mistaken, and not linked where two are possible."""

import tracemalloc

import numpy as np
import pytest

from epipole.tasks.algorithms.orbits.object_linking import (
    NONE,
    ObservedMotions,
    chains,
    link_by_motion,
)
from epipole.tasks.algorithms.orbits.orbit_fit import propagate, trajectory

GEO = np.array([-39359.89, 15125.76, 64.30, -1.1030, -2.8700, 0.01])
LOW = np.array([5000.0, 4000.0, 3000.0, -4.5, 5.2, 1.1])
MINUTE = 60.0
ARC_S = 60.0
RULE = {"gap_s": 7200.0, "log_odds": 4.6}
# 1-sigma of a geostationary object from four low sensors in a minute: km and km/s.
SIGMA = np.array([1.0, 0.5, 0.3, 0.02, 0.008, 0.004])


def covariance(rng, sigma=SIGMA):
    """Return a covariance of this size, with a random rotation that correlates all elements."""
    out = np.zeros((6, 6))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    for part in (slice(0, 3), slice(3, 6)):
        out[part, part] = turn @ np.diag(sigma[part] ** 2) @ turn.T
    return out


def motions(passes, rng, sigma=SIGMA):
    """Return motions with errors; a pass is a true state at time 0, and its ends [s]."""
    heads, tails, head_cov, tail_cov = [], [], [], []
    for truth, first, last in passes:
        (head, tail), _ = trajectory(truth, np.array([first, last]))
        for true, out, covs in ((head, heads, head_cov), (tail, tails, tail_cov)):
            cov = covariance(rng, sigma)
            out.append(rng.multivariate_normal(true, cov))
            covs.append(cov)
    first, last = (np.array([p[k] for p in passes], float) for k in (1, 2))
    return ObservedMotions(
        first, last, first, last, *map(np.array, (heads, tails, head_cov, tail_cov))
    )


def cluster(rng, n=9, spread_km=300.0):
    """Return objects near one place at one altitude, like the satellites of one slot."""
    out = []
    for place in GEO[:3] + rng.normal(size=(n, 3)) * spread_km:
        v = np.cross([0, 0, 1.0], place)
        out.append(np.concatenate([place, v / np.linalg.norm(v) * np.sqrt(398600.44 / 42164)]))
    return out


def lost(objects, gap_s, order):
    """Return passes before and after a gap, those after it in another order."""
    before = [(o, 0.0, ARC_S) for o in objects]
    return before + [(objects[k], ARC_S + gap_s, 2 * ARC_S + gap_s) for k in order]


@pytest.mark.parametrize("gap_min", [1, 5, 10])
def test_a_cluster_is_recognised_after_a_gap(gap_min):
    linked = wrong = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        objects, order = cluster(rng), rng.permutation(9)
        before, odds = link_by_motion(motions(lost(objects, gap_min * MINUTE, order), rng), **RULE)
        assert (before[:9] == NONE).all()
        linked += (before[9:] == order).sum()
        wrong += ((before[9:] != order) & (before[9:] != NONE)).sum()
        assert (odds[before != NONE] >= RULE["log_odds"]).all()
    assert wrong == 0
    assert linked >= 0.95 * 90


def test_half_an_hour_needs_a_longer_arc():
    sigma = SIGMA * np.array([1, 1, 1, 0.1, 0.1, 0.1])  # of ten minutes
    linked = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        objects, order = cluster(rng), rng.permutation(9)
        before, _ = link_by_motion(motions(lost(objects, 1800.0, order), rng, sigma), **RULE)
        linked += (before[9:] == order).sum()
    assert linked >= 0.95 * 90


def test_low_orbits_are_recognised_after_half_a_revolution():
    linked = wrong = 0
    for seed in range(10):
        rng = np.random.default_rng(seed)
        objects = [propagate(LOW + np.append(rng.normal(size=3) * 20, np.zeros(3)),
                             rng.uniform(0, 3000)) for _ in range(12)]  # fmt: skip
        order = rng.permutation(12)
        before, _ = link_by_motion(motions(lost(objects, 2700.0, order), rng), **RULE)
        linked += (before[12:] == order).sum()
        wrong += ((before[12:] != order) & (before[12:] != NONE)).sum()
    assert wrong == 0
    assert linked >= 0.9 * 120


def test_the_difference_of_one_object_is_as_large_as_claimed():
    from epipole.tasks.algorithms.orbits.object_linking import _pairs

    square = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        pairs = _pairs(motions(lost([GEO], 600.0, [0]), rng), 7200.0)
        square.append(pairs.apart[0] @ np.linalg.solve(pairs.cov[0], pairs.apart[0]))
    # The mean of 200 chi-squares of 6 degrees has a relative sigma of 0.041. The assumed
    # acceleration, which the truth does not have, is some metres in 10 minutes.
    assert abs(np.mean(square) / 6 - 1) < 0.12


def test_objects_that_cross_in_the_gap_keep_their_ids():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        meet = propagate(GEO, ARC_S + 150.0)
        crossing = [propagate(meet + np.append(np.zeros(3), [0, side * 0.15, side * 0.15]),
                              -ARC_S - 150.0) for side in (-1, 1)]  # fmt: skip
        before, _ = link_by_motion(motions(lost(crossing, 300.0, [1, 0]), rng), **RULE)
        assert before.tolist() == [NONE, NONE, 1, 0]


def test_a_new_object_beside_an_old_ones_path_is_new():
    taken = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        objects = cluster(rng, n=4)
        new = objects[0] + np.append(rng.normal(size=3) * 40, rng.normal(size=3) * 0.02)
        passes = [*lost(objects, 300.0, [1, 2, 3]), (new, ARC_S + 300.0, 2 * ARC_S + 300.0)]
        before, _ = link_by_motion(motions(passes, rng), **RULE)
        assert before[4:7].tolist() == [1, 2, 3]
        taken += before[7] != NONE
    # 40 km and 20 m/s apart after 300 s are some sigmas; one in a hundred may be mistaken.
    assert taken <= 2


def test_without_a_clear_choice_there_is_no_link():
    rng = np.random.default_rng(1)
    twins = [GEO, GEO + np.array([0.2, 0, 0, 0, 0, 0])]
    before, odds = link_by_motion(motions(lost(twins, 300.0, [0]), rng), **RULE)
    assert (before == NONE).all()
    assert np.isnan(odds).all()


def test_objects_seen_at_the_same_time_are_never_linked():
    rng = np.random.default_rng(2)
    before, _ = link_by_motion(motions([(GEO, 0, 60), (GEO, 60, 120), (GEO, 30, 90)], rng), **RULE)
    assert (before == NONE).all()


def test_a_gap_beyond_the_limit_is_not_bridged():
    seen = motions(lost([GEO], 300.0, [0]), np.random.default_rng(3))
    assert link_by_motion(seen, gap_s=299.0, log_odds=4.6)[0].tolist() == [NONE, NONE]
    assert link_by_motion(seen, gap_s=300.0, log_odds=4.6)[0].tolist() == [NONE, 0]


def unmoving(seen, side, row):
    """Return the same motions, without velocity at one end of one object."""
    state, cov = getattr(seen, side).copy(), getattr(seen, f"{side}_cov").copy()
    state[row, 3:], cov[row, 3:], cov[row, :, 3:] = np.nan, np.nan, np.nan
    return seen._replace(**{side: state, f"{side}_cov": cov})


@pytest.mark.parametrize(("side", "row"), [("head", 1), ("tail", 0)])
def test_one_position_is_enough_where_the_other_moves(side, row):
    seen = motions(lost([GEO], 60.0, [0]), np.random.default_rng(4))
    assert link_by_motion(unmoving(seen, side, row), **RULE)[0].tolist() == [NONE, 0]
    neither = unmoving(unmoving(seen, "head", 1), "tail", 0)
    assert link_by_motion(neither, **RULE)[0].tolist() == [NONE, NONE]


def test_several_gaps_make_one_chain():
    passes = [(GEO, t, t + ARC_S) for t in (600.0, 0.0, 300.0)]
    before, _ = link_by_motion(motions(passes, np.random.default_rng(5)), **RULE)
    assert before.tolist() == [2, NONE, 1]
    assert chains(before).tolist() == [1, 1, 1]


def test_no_objects_and_one_object_have_no_links():
    seen = motions([(GEO, 0.0, 60.0)], np.random.default_rng(6))
    assert link_by_motion(seen, **RULE)[0].tolist() == [NONE]
    nothing = ObservedMotions(*(values[:0] for values in seen))
    assert link_by_motion(nothing, **RULE)[0].shape == (0,)
    assert chains(np.zeros(0, np.int64)).shape == (0,)


def test_the_order_of_the_objects_changes_nothing():
    rng = np.random.default_rng(7)
    passes = lost(cluster(rng), 300.0, rng.permutation(9))
    seen = motions(passes, rng)
    before, _ = link_by_motion(seen, **RULE)
    order = rng.permutation(18)
    place = np.argsort(order)
    mixed, _ = link_by_motion(ObservedMotions(*(values[order] for values in seen)), **RULE)
    expected = np.where(before[order] == NONE, NONE, place[before[order]])
    np.testing.assert_array_equal(mixed, expected)


def test_passes_without_a_velocity_are_all_recognised_by_the_one_that_has_it():
    """Two short passes of one object and a long one: each is compared with the long one."""
    rng = np.random.default_rng(3)
    seen = motions([(LOW, 0, 5), (LOW, 60, 65), (LOW, 120, 180)], rng)
    head, tail = seen.head.copy(), seen.tail.copy()
    head[:2, 3:], tail[:2, 3:] = np.nan, np.nan
    short = seen._replace(head=head, tail=tail)
    before, odds = link_by_motion(short, **RULE)
    assert before.tolist() == [NONE, 0, 1]
    assert (odds[1:] >= RULE["log_odds"]).all()


def test_two_objects_seen_at_one_time_are_not_both_an_earlier_one():
    rng = np.random.default_rng(4)
    seen = motions([(LOW, 0, 60), (LOW, 120, 180), (LOW, 150, 200)], rng)
    before, _ = link_by_motion(seen, **RULE)
    assert before.tolist() == [NONE, NONE, NONE]


def test_objects_that_are_hours_apart_take_no_memory_by_pairs():
    n = 2000
    times = 10_000.0 * np.arange(n)
    states, covs = np.tile(GEO, (n, 1)), np.tile(np.diag(SIGMA**2), (n, 1, 1))
    seen = ObservedMotions(times, times + ARC_S, times, times + ARC_S, states, states, covs, covs)
    tracemalloc.start()
    before, _ = link_by_motion(seen, **RULE)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert (before == NONE).all()
    assert most < 16 * n**2 / 2  # half of two matrices of all pairs

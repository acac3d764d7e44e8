"""Association: what belongs together is found, what does not is left alone or called ambiguous."""

import numpy as np
import pytest

from epipole.tasks.algorithms.association.likelihood import associate_tracklets
from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.orbit_fit import propagate
from epipole.tasks.algorithms.sky import ARCSEC, tangent_basis

GEO = np.array([-39359.89, 15125.76, 64.30])
V_GEO = np.array([-1.103, -2.870, 0.0])
FIELD = np.radians(2.0)
TIMES = np.array([5.0, 17.0, 29.0])


class Scene:
    """Sensors on circles that look at GEO; objects near it; tracklets of strays."""

    def __init__(self, seed, n_sensors, *, sigma_arcsec=1.0, times=TIMES, same_side=True):
        self.rng = np.random.default_rng(seed)
        self.times, self.sigma = times, sigma_arcsec * ARCSEC
        self.r = np.empty((n_sensors, len(times), 3))
        for s in range(n_sensors):
            while True:
                out, along = self.rng.normal(size=(2, 3))
                out /= np.linalg.norm(out)
                if not same_side or out @ GEO > 0.3 * np.linalg.norm(GEO):
                    break
            along = np.cross(out, along)
            along /= np.linalg.norm(along)
            angle = times[:, None] * 7.5 / 7000.0
            self.r[s] = 7000.0 * (np.cos(angle) * out + np.sin(angle) * along)
        self.sensor, self.who, self.seen, self.u = [], [], [], []

    def objects(self, n, spread_km=200.0, seen_by=None):
        for k in range(n):
            start = GEO + self.rng.normal(size=3) * spread_km
            v = V_GEO + self.rng.normal(size=3) * 0.02
            orbit = np.array([propagate(np.concatenate([start, v]), t)[:3] for t in self.times])
            for s in range(len(self.r)) if seen_by is None else seen_by:
                path = orbit - self.r[s]
                self.add(s, k, path / np.linalg.norm(path, axis=1, keepdims=True))
        return self

    def strays(self, n, sensors=None):
        """Tracklets of things that only one sensor sees: they move much like the others."""
        for s in range(len(self.r)) if sensors is None else sensors:
            for _ in range(n):
                path = GEO + self.times[:, None] * V_GEO - self.r[s]
                u = path / np.linalg.norm(path, axis=1, keepdims=True)
                off = self.rng.uniform(-FIELD / 2, FIELD / 2, 2)
                rate = self.rng.normal(size=2) * 2 * ARCSEC
                step = off + self.times[:, None] * rate
                self.add(s, -1, u + np.einsum("ka,kai->ki", step, tangent_basis(u)))
        return self

    def add(self, sensor, who, u, seen=None):
        noise = self.rng.normal(size=(len(self.times), 2)) * self.sigma
        u = u + np.einsum("ka,kai->ki", noise, tangent_basis(u))
        self.u.append(u / np.linalg.norm(u, axis=1, keepdims=True))
        self.sensor.append(sensor)
        self.who.append(who)
        self.seen.append(np.ones(len(self.times), bool) if seen is None else seen)

    def samples(self, order=None):
        order = np.arange(len(self.who)) if order is None else order
        sensor = np.array(self.sensor, np.int64)[order]
        seen = np.array(self.seen).reshape(-1, len(self.times))[order]
        first = np.array([self.times[np.flatnonzero(s)[0]] for s in seen])
        last = np.array([self.times[np.flatnonzero(s)[-1]] for s in seen])
        look = GEO + self.times[:, None] * V_GEO - self.r
        look /= np.linalg.norm(look, axis=2, keepdims=True)
        n_sensors = len(self.r)
        u = np.array(self.u).reshape(-1, len(self.times), 3)[order]
        return Samples(
            sensor=sensor,
            start_s=first,
            end_s=last,
            seen=seen,
            u=u,
            cov=np.tile(np.eye(2) * self.sigma**2, (*u.shape[:2], 1, 1)),
            sigma_km=np.full(u.shape[:2], 0.02),
            time_s=self.times,
            sensor_km=self.r,
            R_sensor_from_icrs=np.concatenate([tangent_basis(look), look[:, :, None]], axis=2),
            half_field=np.full((n_sensors, 2), np.tan(FIELD / 2)),
        )


def solve(samples, **changes):
    options = {
        "gate_sigma": 4.5,
        "min_altitude_km": 100.0,
        "max_range_km": 1e5,
        "min_log_odds": 3.0,
        "ambiguity_log_odds": 3.0,
    }
    return associate_tracklets(samples, **options | changes)


def pairs(label):
    """Pairs of tracklets that carry one label."""
    return {
        (i, j)
        for i in range(len(label))
        for j in range(i + 1, len(label))
        if label[i] == label[j] >= 0
    }


def judge(scene, groups):
    """Pair precision and recall."""
    found, true = pairs(groups.group), pairs(np.array(scene.who))
    return len(found & true) / max(len(found), 1), len(found & true) / max(len(true), 1)


@pytest.mark.parametrize("n_sensors", [3, 4, 8])
def test_objects_are_found_among_strays(n_sensors):
    scene = Scene(n_sensors, n_sensors).objects(20).strays(20)
    precision, recall = judge(scene, solve(scene.samples()))
    assert precision > 0.995
    assert recall > 0.97


def test_two_sensors_suffice_where_strays_are_few():
    scene = Scene(1, 2).objects(5).strays(2)
    precision, recall = judge(scene, solve(scene.samples()))
    assert precision == 1.0
    assert recall >= 0.8


def test_two_sensors_at_one_instant_in_dense_clutter_report_next_to_nothing_wrong():
    scene = Scene(2, 2, times=np.array([0.0])).objects(5).strays(200)
    groups = solve(scene.samples())
    wrong = pairs(groups.group) - pairs(np.array(scene.who))
    assert len(wrong) <= 2


def test_two_objects_that_two_sensors_cannot_tell_apart_are_ambiguous():
    scene = Scene(3, 2, times=np.array([0.0]))
    # Both in one epipolar plane of both sensors: each of the four pairings meets at a point.
    baseline = scene.r[1, 0] - scene.r[0, 0]
    towards = (GEO - scene.r[0, 0]) / np.linalg.norm(GEO - scene.r[0, 0])
    across = baseline - (baseline @ towards) * towards
    across /= np.linalg.norm(across)
    for k, off in enumerate((-40.0, 40.0)):
        for s in range(2):
            path = GEO + off * across + scene.times[:, None] * V_GEO - scene.r[s]
            scene.add(s, k, path / np.linalg.norm(path, axis=1, keepdims=True))
    groups = solve(scene.samples())
    assert groups.ambiguous.all()
    assert (groups.group == -1).all()


def test_strays_alone_make_no_object():
    scene = Scene(4, 4).strays(20)
    groups = solve(scene.samples())
    assert (groups.group >= 0).sum() <= 4


def test_a_sensor_never_has_two_tracklets_of_one_object_at_once():
    scene = Scene(5, 4).objects(30, spread_km=5.0)
    samples = scene.samples()
    groups = solve(samples)
    for g in range(len(groups.score)):
        sensors = samples.sensor[groups.group == g]
        assert len(set(sensors.tolist())) == len(sensors)


def test_two_fragments_of_one_sensor_join_one_object():
    scene = Scene(6, 3).objects(1, seen_by=[0, 1])
    for seen in ([True, False, False], [False, False, True]):
        # The same object from the third sensor, in two pieces.
        sight = _where(scene) - scene.r[2]
        scene.add(2, 0, sight / np.linalg.norm(sight, axis=1, keepdims=True), np.array(seen))
    groups = solve(scene.samples())
    assert groups.group.tolist() == [0, 0, 0, 0]


def _where(scene):
    """The point nearest to the first two tracklets' lines, instant by instant."""
    out = []
    for k in range(len(scene.times)):
        N, b = np.zeros((3, 3)), np.zeros(3)
        for i in range(2):
            P = np.eye(3) - np.outer(scene.u[i][k], scene.u[i][k])
            N, b = N + P, b + P @ scene.r[scene.sensor[i], k]
        out.append(np.linalg.solve(N, b))
    return np.array(out)


def test_an_object_below_the_ground_or_behind_the_earth_is_none():
    scene = Scene(7, 3)
    inside = np.array([6000.0, 0.0, 0.0])
    for s in range(3):
        path = np.tile(inside, (3, 1)) - scene.r[s]
        scene.add(s, 0, path / np.linalg.norm(path, axis=1, keepdims=True))
    assert (solve(scene.samples()).group == -1).all()
    scene = Scene(7, 3)
    scene.r[:] = -scene.r  # the Earth now stands between
    scene.objects(3)
    assert (solve(scene.samples()).group == -1).all()


def test_the_order_of_the_tracklets_does_not_matter():
    scene = Scene(8, 4).objects(10).strays(10)
    order = np.random.default_rng(0).permutation(len(scene.who))
    one, other = solve(scene.samples()), solve(scene.samples(order))
    assert pairs(one.group) == {tuple(sorted((order[i], order[j]))) for i, j in pairs(other.group)}


def test_one_sensor_alone_has_no_object():
    scene = Scene(9, 1).objects(5)
    assert (solve(scene.samples()).group == -1).all()


def test_no_tracklet_gives_no_group():
    scene = Scene(10, 2).objects(1)
    nothing = Samples(*(
        value[:0] if i < 7 else value for i, value in enumerate(scene.samples())
    ))  # fmt: skip
    groups = solve(nothing)
    assert len(groups.group) == len(groups.score) == 0

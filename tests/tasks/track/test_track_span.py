"""Build tracklets: kinds of detections, joined fragments, frames without attitude."""

import numpy as np
import polars as pl
import pyarrow as pa
import pytest
from scenes.cameras import cameras_of
from scenes.identified import identified, tracked
from scipy.spatial.transform import Rotation

from epipole.flows.command_line.log_info import of_sensor
from epipole.schemas.bridge import array, table
from epipole.schemas.columns import TIME
from epipole.schemas.given_settings import validate_settings
from epipole.schemas.settings import Settings
from epipole.schemas.tables import DETECTIONS, STARS
from epipole.schemas.work_tables import SOLUTIONS
from epipole.tasks.algorithms.geometry.camera import Camera, project, row_offset_s, unproject
from epipole.tasks.algorithms.geometry.directions import radec_from_unit
from epipole.tasks.common.sightings import Frames
from epipole.tasks.track.classify_detections import star_directions

SCENE = """
name = "kinds"
start = 2019-04-01T04:00:00Z
duration_s = 60.0
seed = 11
[[sensors]]
id = "a"
rate_hz = 1.0
magnitude_limit = 8.0
orbit = { a_km = 6977.6, i_deg = 35.0, raan_deg = 354.4, argp_deg = 71.8, true_anomaly_deg = 39.8 }
camera = { width = 1024, height = 1024, fov_deg = 6.0 }
detection = { sigma_px = 0.15, false_points = 3.0, hot_pixels = 6, target_drop = 0.05 }
pointing = { mode = "track", orbit = { position_km = [-39359.89, 15125.76, 64.30] } }
[[targets]]
count = 5
orbit = { position_km = [-39359.89, 15125.76, 64.30] }
spread_km = 400.0
magnitude = 7.0
"""
GAP = (18, 44)  # frames from and to that show no object


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    from scenes.whole_logs import read_whole

    from epipole.flows.simulate import simulate
    from epipole.io.catalogues.hipparcos import read_hipparcos
    from epipole.tasks.identify.frame_inputs import interpolate_sensor_states

    folder = tmp_path_factory.mktemp("kinds")
    (folder / "scene.toml").write_text(SCENE)
    simulate(str(folder / "scene.toml"), folder / "k.mcap")
    settings = validate_settings({}, "test")
    log = read_whole([str(folder / "k.mcap")], settings)
    places = interpolate_sensor_states(log.exposures, log.states, settings.sensors)
    found = identified(log.exposures, places, log.cameras, read_hipparcos(), settings)
    truth = pl.read_parquet(folder / "k.mcap.truth" / "points.parquet")
    return found._replace(detections=steadied(found.detections, truth)), log.cameras, truth


def steadied(detections, truth):
    """The detections, but hot pixels scatter by a tenth of what the simulator gives them."""
    rows = pl.from_arrow(detections.select(["frame_number", "centroid", "x_px", "y_px"]))
    kind = rows.join(
        truth.select("frame_number", "centroid", "kind"), on=["frame_number", "centroid"],
        how="left", maintain_order="left",
    )["kind"].to_numpy()  # fmt: skip
    place = rows.select("x_px", "y_px").to_numpy()
    middle = np.round(place)
    _, pixel, count = np.unique(middle, axis=0, return_inverse=True, return_counts=True)
    hot = (kind == 2) & (count[pixel.ravel()] > 20)
    place = np.where(hot[:, None], middle + 0.1 * (place - middle), place)
    for k, name in enumerate(("x_px", "y_px")):
        at = detections.schema.get_field_index(name)
        detections = detections.set_column(at, detections.schema.field(at), [place[:, k]])
    return detections


def build(seen, broken=False, suspects=False, **tracklets):
    found, cameras, truth = seen
    detections = of_sensor(found.detections, "a")
    if broken:
        frame = detections["frame_number"].to_numpy()
        first = frame.min()
        detections = detections.filter((frame < first + GAP[0]) | (frame >= first + GAP[1]))
    settings = validate_settings({"tracklets": tracklets}, "test")
    built = tracked(of_sensor(found.solutions, "a"), detections, cameras, settings)
    key = ["sensor_id", "frame_number", "centroid"]
    cast = [pl.col("frame_number").cast(pl.Int64), pl.col("centroid").cast(pl.Int64)]
    known = pl.from_arrow(built.detections).rename({"kind": "taken_for"}).with_columns(cast)
    rows = built.suspects if suspects else built.tracklets
    return known.join(truth.with_columns(cast), on=key, how="left"), rows


def test_a_sensor_that_follows_objects_tells_them_from_hot_pixels(seen):
    detections, tracklets = build(seen)
    objects = detections.filter(pl.col("kind") == 1)
    assert (objects["taken_for"] == "object").mean() > 0.99
    strays = detections.filter(pl.col("kind") == 2)
    assert (strays["taken_for"] == "hot_pixel").sum() > 0.95 * 6 * 60
    assert (strays["taken_for"] == "object").sum() == 0
    assert tracklets.num_rows == 5


def moved_to_one_pixel(seen, target):
    """What `seen` has, but the sensor holds an object on the middle of a pixel."""
    found, cameras, truth = seen
    rows = pl.from_arrow(found.detections.select(["frame_number", "centroid"]))
    source = rows.join(
        truth.filter(pl.col("kind") == 1), on=["frame_number", "centroid"], how="left",
        maintain_order="left",
    )["source"].fill_null(-1).to_numpy()  # fmt: skip
    rng, detections, chosen = np.random.default_rng(1), found.detections, source == target
    for name, middle in (("x_px", 300.0), ("y_px", 400.0)):
        at = detections.schema.get_field_index(name)
        value = detections[name].to_numpy().copy()
        value[chosen] = middle + 0.15 * rng.normal(size=chosen.sum())
        detections = detections.set_column(at, detections.schema.field(at), [value])
    return found._replace(detections=detections), cameras, truth


@pytest.mark.parametrize("target", range(3))
def test_an_object_held_on_the_middle_of_a_pixel_has_its_tracklet(seen, target):
    detections, suspects = build(moved_to_one_pixel(seen, target), suspects=True)
    held = detections.filter((pl.col("kind") == 1) & (pl.col("source") == target))
    assert len(held) > 50
    assert (held["taken_for"] == "object").mean() > 0.95
    assert set(suspects["tracklet_id"].to_pylist()) <= set(held["tracklet_id"].to_list())
    strays = detections.filter(pl.col("kind") == 2)
    assert (strays["taken_for"] == "hot_pixel").sum() > 0.95 * 6 * 60


def test_hot_pixels_that_scatter_as_light_are_suspects_until_other_sensors_are_asked(seen):
    found, cameras, truth = seen
    detections = found.detections
    for name in ("x_px", "y_px"):
        at = detections.schema.get_field_index(name)
        value = detections[name].to_numpy()
        off = value - np.round(value)
        hot = np.abs(off) < 0.08
        value = np.where(hot, np.round(value) + 10 * off, value)
        detections = detections.set_column(at, detections.schema.field(at), [value])
    detections, suspects = build(
        (found._replace(detections=detections), cameras, truth), suspects=True
    )
    named = set(suspects["tracklet_id"].to_pylist())
    strays = detections.filter(pl.col("kind") == 2)
    judged = (strays["taken_for"] == "hot_pixel") | strays["tracklet_id"].is_in(list(named))
    assert judged.sum() > 0.9 * 6 * 60
    assert not detections.filter(pl.col("kind") == 1)["tracklet_id"].is_in(list(named)).any()


def test_only_objects_have_tracklets_and_tracks(seen):
    detections, _ = build(seen)
    other = detections.filter(pl.col("taken_for") != "object")
    assert other["tracklet_id"].null_count() == len(other)
    assert other["track_id"].null_count() == len(other)


@pytest.mark.parametrize("method", ["likelihood_ratio", "prediction"])
def test_after_a_break_each_object_has_one_track(seen, method):
    detections, tracklets = build(seen, broken=True, link_method=method)
    assert tracklets.num_rows == 10
    assert tracklets["link_chi2"].null_count == 5
    tracked = detections.drop_nulls("track_id")
    assert tracked["track_id"].n_unique() == 5
    assert (tracked.group_by("track_id").agg(pl.col("source").n_unique())["source"] == 1).all()


def test_joining_can_be_switched_off(seen):
    detections, tracklets = build(seen, broken=True, link_method="none")
    assert detections["track_id"].drop_nulls().n_unique() == 10
    assert tracklets["link_chi2"].null_count == 10


def without_attitude(found, lost):
    """The identified tables, but these frames (counted from the first) have no attitude."""
    import pyarrow as pa
    import pyarrow.compute as pc

    solutions, detections = of_sensor(found.solutions, "a"), of_sensor(found.detections, "a")
    first = solutions["frame_number"].to_numpy().min()
    numbers = pa.array(first + np.array(lost), pa.int64())
    for name, rows in (("attitude_source", solutions), ("ra_deg", detections)):
        at = rows.schema.get_field_index(name)
        gone = pc.is_in(rows["frame_number"], numbers)
        value = pa.scalar("none" if name == "attitude_source" else None, rows.schema.field(at).type)
        rows = rows.set_column(at, rows.schema.field(at), pc.if_else(gone, value, rows[name]))
        solutions, detections = (rows, detections) if rows.num_columns > 20 else (solutions, rows)
    return solutions, detections


def test_frames_without_attitude_are_tracked_in_the_image(seen):
    found, cameras, _ = seen
    settings = validate_settings({}, "test")
    solutions, detections = without_attitude(found, range(20, 32))
    built = tracked(solutions, detections, cameras, settings)
    assert built.tracklets.num_rows == 15  # five before, five after, five in between
    assert len(set(built.tracklets["tracklet_id"].to_pylist())) == 15
    assert built.tracklets["link_chi2"].null_count == 10
    kind = np.array(built.detections["kind"].to_pylist())
    assert (kind == "object").sum() > 0.9 * 5 * 60


def test_frames_without_attitude_that_are_far_apart_give_no_track(seen):
    found, cameras, _ = seen
    solutions, detections = without_attitude(found, range(0, 60, 8))
    built = tracked(solutions, detections, cameras, validate_settings({}, "test"))
    assert built.tracklets.num_rows == 5


def test_no_detections_give_no_tracklets(seen):
    found, cameras, _ = seen
    settings = validate_settings({}, "test")
    built = tracked(found.solutions, found.detections.slice(0, 0), cameras, settings)
    assert built.tracklets.num_rows == 0


def test_a_frame_of_ten_thousand_strays_breaks_no_track(seen):
    import pyarrow as pa

    found, cameras, _ = seen
    detections = of_sensor(found.detections, "a")
    row = detections.slice(detections.num_rows // 2, 1)
    many = pa.concat_tables([row] * 10_000)
    rng = np.random.default_rng(0)
    for name, spread in (("ra_deg", 3.0), ("dec_deg", 3.0), ("x_px", 500.0), ("y_px", 500.0)):
        at = many.schema.get_field_index(name)
        values = many[name].to_numpy() + rng.uniform(-spread, spread, 10_000)
        many = many.set_column(at, many.schema.field(at), pa.array(values))
    at = many.schema.get_field_index("centroid")
    numbers = pa.array(np.arange(10_000, dtype=np.int32) + 1000)
    many = many.set_column(at, many.schema.field(at), numbers)
    built = tracked(
        of_sensor(found.solutions, "a"), pa.concat_tables([detections, many]), cameras,
        validate_settings({}, "test"),
    )  # fmt: skip
    kept = built.detections["tracklet_id"].drop_null()
    assert 5 <= built.tracklets.num_rows <= 6
    assert len(kept) > 0.97 * 5 * 57


N = 600
TIME_NS = (np.arange(N) * 1e9).astype(np.int64)
CAMERA = {"width": 1024, "height": 1024, "fx_px": 9770.0, "fy_px": 9770.0, "cx_px": 511.5}
CAMERA |= {"cy_px": 511.5, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}


def filled(schema, n, **given):
    """Return a table of `n` rows; other columns are null, or else 0 or empty."""
    for field in schema:
        if field.name not in given:
            empty = "" if field.type == pa.string() else 0
            value = None if field.nullable else empty
            kind = pa.int64() if field.type == TIME else field.type
            given[field.name] = pa.array([value] * n, kind).cast(field.type)
    return table(schema, given)


KEY = {"sensor_id": ["a"] * N, "frame_number": np.arange(N), "time": TIME_NS}


def still_sensor():
    """Return SOLUTIONS of a sensor whose attitude does not change, from stars, for ten minutes."""
    return filled(
        SOLUTIONS, N, **KEY, attitude_source=["stars"] * N,
        qx=np.zeros(N), qy=np.zeros(N), qz=np.zeros(N), qw=np.ones(N),
        **{f"cov_att_{ab}_arcsec2": np.full(N, 1.0 if ab in ("xx", "yy", "zz") else 0.0)
           for ab in ("xx", "xy", "xz", "yy", "yz", "zz")},
    )  # fmt: skip


def kinds(rate_arcsec_s, bend_arcsec_s2=0.0):
    """Return the kinds of the detections of a point that moves for ten minutes.

    At this rate, and with this acceleration, in the middle of which it turns back.
    """
    rng = np.random.default_rng(1)
    off = 600.0 + rate_arcsec_s * np.arange(N) + rng.normal(0, 3.0, N)
    off += bend_arcsec_s2 / 2 * (np.arange(N) - (N - 1) / 2) ** 2
    detections = filled(
        DETECTIONS, N, **KEY, ra_deg=30 + rng.normal(0, 3.0, N) / off * 57.3,
        dec_deg=90.0 - off / 3600, sigma_arcsec=np.full(N, 3.0), kind=["unknown"] * N,
        x_px=500 + off / 21.1, y_px=np.full(N, 300.3) + rng.normal(0, 0.14, N),
    )  # fmt: skip
    cameras = cameras_of({"a": Camera(**CAMERA)})
    built = tracked(still_sensor(), detections, cameras, Settings())
    return built.detections["kind"].to_pylist()


@pytest.mark.parametrize(
    ("rate_arcsec_s", "kind"), [(0.0, "star_unlisted"), (0.02, "star_unlisted"), (0.5, "object")]
)
def test_a_slow_drift_is_a_stars_and_a_faster_one_an_objects(rate_arcsec_s, kind):
    assert kinds(rate_arcsec_s).count(kind) > 0.98 * N


def test_an_object_whose_motion_turns_back_is_no_star():
    """As a geostationary one does for a low sensor: its mean rate over the ten minutes is 0."""
    assert kinds(0.0, 0.04).count("object") > 0.98 * N


def crossing(time_s, source="stars"):
    """Return the tracklets of a point that crosses the image in each 40 s, seen at these times."""
    n, rng = len(time_s), np.random.default_rng(1)
    at_px = np.array([[100.0], [500.0]]) + np.outer([20.0, 3.0], time_s % 40.0)
    at_px += rng.normal(0, 0.15, (2, n))
    ra, dec = radec_from_unit(unproject(Camera(**CAMERA), *at_px))
    names = {"sensor_id": ["a"] * n, "frame_number": np.arange(n)}
    names["time"] = np.round(time_s * 1e9).astype(np.int64)
    detections = filled(
        DETECTIONS, n, **names, ra_deg=np.degrees(ra), dec_deg=np.degrees(dec),
        sigma_arcsec=np.full(n, 3.0), kind=["unknown"] * n, x_px=at_px[0], y_px=at_px[1],
    )  # fmt: skip
    solutions = filled(
        SOLUTIONS, n, **names, attitude_source=[source] * n,
        **{f"q{a}": np.full(n, float(a == "w")) for a in "xyzw"},
        **{f"cov_att_{ab}_arcsec2": np.full(n, float(ab[0] == ab[1]))
           for ab in ("xx", "xy", "xz", "yy", "yz", "zz")},
    )  # fmt: skip
    return tracked(solutions, detections, cameras_of({"a": Camera(**CAMERA)}), Settings())


@pytest.mark.parametrize("source", ["stars", "none"])
@pytest.mark.parametrize("fast_s", [0.2, 0.05])
def test_objects_are_followed_where_the_rate_of_frames_changes(fast_s, source):
    slow, fast = np.arange(300.0), np.arange(300.0, 420.0, fast_s)
    for time_s in (np.concatenate([slow, fast]), np.concatenate([fast - 300.0, slow + 120.0])):
        followed = array(crossing(time_s, source).detections, "kind") == "object"
        is_slow = (time_s < 300.0) if time_s[1] == 1.0 else (time_s >= 120.0)
        assert followed[is_slow].mean() > 0.98
        assert followed[~is_slow].mean() > 0.98


@pytest.mark.parametrize("n", [150, 149])
def test_objects_are_followed_through_pairs_of_exposures(n):
    time_s = np.sort(np.concatenate([np.arange(75) * 2.0, np.arange(75) * 2.0 + 0.1]))[:n]
    tracklets = crossing(time_s).tracklets
    assert tracklets.num_rows == 4
    assert array(tracklets, "n_detections").sum() > 0.98 * n


def kinds_under_a_prior(rate_arcsec_s, shaken_arcsec, n=20):
    """Return the kinds of the detections of a point in `n` frames whose attitudes are priors.

    Their errors differ from frame to frame; the image moves by three pixels a frame.
    """
    rng = np.random.default_rng(3)
    camera = Camera(**CAMERA)
    at_px = np.array([[400.0], [300.0]]) + rng.normal(0, shaken_arcsec / 21.1, (2, n))
    at_px[0] += rate_arcsec_s * np.arange(n) / 21.1
    ra, dec = radec_from_unit(unproject(camera, *at_px))
    names = {"sensor_id": ["a"] * n, "frame_number": np.arange(n), "time": TIME_NS[:n]}
    detections = filled(
        DETECTIONS, n, **names, ra_deg=np.degrees(ra), dec_deg=np.degrees(dec),
        sigma_arcsec=np.full(n, 2.1), kind=["unknown"] * n, x_px=50 + at_px[0] + 3 * np.arange(n),
        y_px=at_px[1],
    )  # fmt: skip
    solutions = still_sensor().slice(0, n)
    for name, values in {
        "attitude_source": ["prior"] * n,
        **{f"cov_att_{a}{a}_arcsec2": np.full(n, 400.0) for a in "xyz"},
    }.items():
        at = solutions.schema.get_field_index(name)
        solutions = solutions.set_column(at, solutions.schema.field(at), pa.array(values))
    built = tracked(solutions, detections, cameras_of({"a": camera}), Settings())
    return built.detections["kind"].to_pylist()


@pytest.mark.parametrize(
    ("rate_arcsec_s", "shaken_arcsec", "kind"),
    [(0.0, 0.0, "star_unlisted"), (0.0, 10.0, "star_unlisted"), (15.0, 10.0, "object")],
)
def test_a_prior_that_changes_from_frame_to_frame_makes_no_object_of_a_star(
    rate_arcsec_s, shaken_arcsec, kind
):
    found = kinds_under_a_prior(rate_arcsec_s, shaken_arcsec)
    assert found.count(kind) > 0.9 * len(found)


def resting(runs_at, identified_at, rate_arcsec_s=0.0):
    """Return the kinds of the detections of a point that is detected in short runs, five frames
    each, and was identified as a star in other frames."""
    rng = np.random.default_rng(2)
    camera = Camera(**CAMERA)
    x_px, y_px = 700.0, 300.0
    frame = np.concatenate([np.arange(k, k + 5) for k in runs_at])
    n = len(frame)
    x = x_px + rate_arcsec_s * (frame - frame[0]) / 21.1 + rng.normal(0, 0.2, n)
    y = y_px + rng.normal(0, 0.2, n)
    u = unproject(camera, x, y)
    ra, dec = radec_from_unit(u)
    detections = filled(
        DETECTIONS, n, sensor_id=["a"] * n, frame_number=frame, time=TIME_NS[frame],
        ra_deg=np.degrees(ra), dec_deg=np.degrees(dec), sigma_arcsec=np.full(n, 4.2),
        kind=["unknown"] * n, x_px=x, y_px=y,
    )  # fmt: skip
    at = np.array(identified_at, np.int64)
    stars = filled(
        STARS, len(at), sensor_id=["a"] * len(at), frame_number=at, time=TIME_NS[at],
        star_id=np.full(len(at), 7), x_px=x_px + rng.normal(0, 0.2, len(at)),
        y_px=y_px + rng.normal(0, 0.2, len(at)),
    )  # fmt: skip
    cameras = cameras_of({"a": camera})
    return tracked(still_sensor(), detections, cameras, Settings(), stars)


def test_what_rests_where_a_star_is_identified_in_other_frames_is_that_star():
    built = resting(runs_at=[10, 40], identified_at=range(100, 140))
    assert set(built.detections["kind"].to_pylist()) == {"star_unlisted"}
    assert built.tracklets.num_rows == 0


def test_what_rests_where_no_star_is_may_be_an_object():
    built = resting(runs_at=[10], identified_at=[])
    assert set(built.detections["kind"].to_pylist()) == {"object"}


def test_what_moves_away_from_a_star_is_an_object():
    built = resting(runs_at=[10], identified_at=range(100, 140), rate_arcsec_s=30.0)
    assert set(built.detections["kind"].to_pylist()) == {"object"}


def frames_of(rotation_vectors, camera):
    """Return Frames of one sensor at rest in GCRF, one a second, with these attitudes."""
    n = len(camera)
    q = Rotation.from_rotvec(rotation_vectors).as_quat()
    at = np.zeros((n, 3))
    second = np.arange(n)
    return Frames(
        pa.table({}), second, second * 10**9, q, np.zeros((n, 3, 3)), np.ones(n, bool),
        at, at, np.zeros(n), np.array(camera),
    )  # fmt: skip


def stars_at(x_px, y_px):
    n = len(x_px)
    frame = {"frame_number": np.arange(n), "star_id": np.full(n, 7)}
    return pa.table(frame | {"x_px": np.array(x_px), "y_px": np.array(y_px)})


STAR = np.array([0.02, 0.08, 1.0]) / np.linalg.norm([0.02, 0.08, 1.0])
FULL = Camera(1024, 1024, 5000.0, 5000.0, 511.5, 511.5)


def test_a_star_is_where_each_frames_camera_puts_it():
    binned = Camera(512, 512, 2500.0, 2500.0, 255.5, 255.5)
    pixels = [project(camera, STAR[None]) for camera in (FULL, binned)]
    stars = stars_at(*np.array(pixels)[:, :, 0].T)
    cameras = cameras_of({"a": FULL, "b": binned})
    found = star_directions(frames_of(np.zeros((2, 3)), [0, 1]), stars, cameras)
    np.testing.assert_allclose(found, [STAR], atol=1e-9)


def test_a_star_of_a_rolling_shutter_is_where_it_was_at_the_time_of_the_frame():
    camera, rate = FULL._replace(line_time_s=2e-5), np.array([0.0, np.radians(0.3), 0.0])
    turns, pixels = np.outer(np.arange(4), rate), []
    for turn in turns:
        late_s = 0.0
        for _ in range(5):
            u = Rotation.from_rotvec(rate * late_s).apply(Rotation.from_rotvec(turn).apply(STAR))
            x, y = project(camera, u[None])
            late_s = row_offset_s(camera, y)[0]
        pixels.append((x[0], y[0]))
    stars = stars_at(*np.array(pixels).T)
    found = star_directions(frames_of(turns, [0] * 4), stars, cameras_of({"a": camera}))
    np.testing.assert_allclose(found, [STAR], atol=1e-8)  # without it 4e-5

"""The overlay of a night: read back by public tools, and held against tables and geometry."""

import datetime
import json
import shutil
import struct
from collections import Counter, defaultdict
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow.parquet as pq
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from epipole.flows import api
from epipole.flows.command_line.main import app
from epipole.flows.overlay import overlay
from epipole.flows.simulate import simulate
from epipole.schemas.errors import DatasetError, LogError, NoFramesError
from epipole.tasks.overlay.layout import viewer_layout

NIGHT = "2019-04-01"


def messages(path) -> dict[str, list]:
    """Return the messages of each schema: (topic, log time, message)."""
    found = defaultdict(list)
    with path.open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            found[schema.name].append((channel.topic, message.log_time, decoded))
    return found


@pytest.fixture(scope="module")
def written(night_log, night_dataset, tmp_path_factory):
    path = tmp_path_factory.mktemp("overlay") / "overlay.mcap"
    made = overlay(str(night_dataset), [str(night_log)], path, images=True)
    return path, made, messages(path)


def table(dataset, name) -> pl.DataFrame:
    return pl.read_parquet(f"{dataset}/night={NIGHT}/{name}/*.parquet")


def at(stamp) -> int:
    return stamp.seconds * 1_000_000_000 + stamp.nanos


def test_every_frame_has_its_stars_and_detections_at_its_time(written, night_dataset):
    _, made, found = written
    frames = table(night_dataset, "frames")
    drawn = found["foxglove.ImageAnnotations"]
    assert made.frames == len(drawn) == len(frames)
    assert made.without_rows == 0
    times = frames["time"].dt.timestamp("ns").to_list()
    topics = [f"/{sensor}/annotations" for sensor in frames["sensor_id"]]
    expected = sorted(zip(topics, times, strict=True))
    assert sorted((topic, time_ns) for topic, time_ns, _ in drawn) == expected
    assert sum(len(m.circles) for _, _, m in drawn) == len(table(night_dataset, "stars"))
    detections = table(night_dataset, "detections")
    assert sum(len(m.points) for _, _, m in drawn) == len(detections)
    assert all(at(c.timestamp) == time_ns for _, time_ns, m in drawn for c in m.circles)


def test_a_star_is_named_and_ringed_half_a_pixel_from_its_centroid(written, night_dataset):
    _, _, found = written
    stars = table(night_dataset, "stars")
    star, ns = stars.row(100, named=True), stars["time"].dt.timestamp("ns")[100]
    (drawn,) = [
        message
        for topic, time_ns, message in found["foxglove.ImageAnnotations"]
        if (topic, time_ns) == (f"/{star['sensor_id']}/annotations", ns)
    ]
    places = [(circle.position.x, circle.position.y) for circle in drawn.circles]
    assert (star["x_px"] + 0.5, star["y_px"] + 0.5) in places
    assert f"HIP {star['star_id']}" in [text.text for text in drawn.texts]


def test_detections_of_an_object_carry_its_id(written, night_dataset):
    _, _, found = written
    shown = table(night_dataset, "associations").select("tracklet_id", "object_id").unique()
    of_object = table(night_dataset, "detections").join(shown, on="tracklet_id")
    named = Counter(text.text for _, _, m in found["foxglove.ImageAnnotations"] for text in m.texts)
    expected = Counter(of_object["object_id"].to_list())
    assert len(expected) == 9
    assert {name: named[name] for name in expected} == dict(expected)


def test_an_object_lies_behind_its_detection_by_the_files_own_geometry(written, night_dataset):
    _, _, found = written
    cameras = {m.frame_id: m for _, _, m in found["foxglove.CameraCalibration"]}
    poses = {(m.child_frame_id, at(m.timestamp)): m for _, _, m in found["foxglove.FrameTransform"]}
    frames = table(night_dataset, "frames")
    keys = zip(frames["sensor_id"], frames["frame_number"], strict=True)
    when = dict(zip(keys, frames["time"].dt.timestamp("ns"), strict=True))
    seen = table(night_dataset, "associations").filter("used")
    seen = seen.with_columns(ns=pl.col("epoch").dt.timestamp("ns"))
    places = {
        (entity.id, time_ns): entity.spheres[0].pose.position
        for _, time_ns, update in found["foxglove.SceneUpdate"]
        for entity in update.entities
    }
    off_px = []
    for row in seen.iter_rows(named=True):
        pose = poses[row["sensor_id"], when[row["sensor_id"], row["frame_number"]]]
        place = places[row["object_id"], row["ns"]]
        q, t = pose.rotation, pose.translation
        line = np.array([place.x - t.x, place.y - t.y, place.z - t.z])
        x, y, z = Rotation.from_quat([q.x, q.y, q.z, q.w]).inv().apply(line)
        k = cameras[row["sensor_id"]].K
        off = k[0] * x / z + k[2] - row["x_px"], k[4] * y / z + k[5] - row["y_px"]
        off_px.append(np.hypot(*off))
    # The sensor has moved between the frame and the epoch, and the Earth's motion moves stars by
    # 20 arcsec, which is in the attitude. A pixel is 14 arcsec.
    assert len(off_px) > 1000
    assert np.median(off_px) < 4


def test_the_scene_has_each_object_with_a_line_of_sight_per_view(written, night_dataset):
    _, made, found = written
    positions = table(night_dataset, "positions")
    updates = [m for _, _, m in found["foxglove.SceneUpdate"]]
    earth = [e for m in updates for e in m.entities if e.id == "Earth"]
    assert [e.spheres[0].size.x for e in earth] == [2 * 6_378_137.0]
    entities = [e for m in updates for e in m.entities if e.id != "Earth"]
    assert len(entities) == len(positions)
    assert made.epochs == positions["epoch"].n_unique()
    used = table(night_dataset, "associations").filter("used")
    assert sum(len(e.lines[0].points) for e in entities) == 2 * len(used)
    sigma_km = positions.select(pl.sum_horizontal("cov_xx", "cov_yy", "cov_zz").sqrt())
    sizes = [e.spheres[1].size for e in entities]
    axes_m = [np.linalg.norm([size.x, size.y, size.z]) for size in sizes]
    np.testing.assert_allclose(sorted(axes_m), sorted(6000 * sigma_km.to_series()), rtol=1e-6)


def test_an_error_ellipsoid_is_turned_as_its_covariance(written, night_dataset):
    _, _, found = written
    row = table(night_dataset, "positions").sort("epoch", "object_id").row(0, named=True)
    (entity,) = [
        e for _, _, m in found["foxglove.SceneUpdate"][:2] for e in m.entities
        if e.id == row["object_id"]
    ]  # fmt: skip
    ball = entity.spheres[1]
    turn = ball.pose.orientation
    axes = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]).as_matrix()
    half_km = np.array([ball.size.x, ball.size.y, ball.size.z]) / 2000 / 3
    xx, xy, xz, yy, yz, zz = (row[f"cov_{a}"] for a in ("xx", "xy", "xz", "yy", "yz", "zz"))
    covariance = axes @ np.diag(half_km**2) @ axes.T
    np.testing.assert_allclose(covariance, [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], rtol=1e-6)


def test_images_show_the_centroids(written):
    _, _, found = written
    images = [m for _, _, m in found["foxglove.CompressedImage"]]
    assert len(images) == 240
    assert {image.format for image in images} == {"png"}
    assert all(image.data.startswith(b"\x89PNG") for image in images)


def test_images_have_the_size_of_the_calibration_at_their_time(night_log, night_dataset, tmp_path):
    log = api.read_log(night_log)
    half = log.frames["time"].min() + datetime.timedelta(seconds=30)
    later = pl.lit(half).cast(log.cameras.schema["time"])
    binned = log.cameras.filter(sensor_id="sat1").with_columns(time=later, width=256, height=128)
    cameras = pl.concat([log.cameras, binned.cast(log.cameras.schema)])
    api.write_log(tmp_path / "b.mcap", log.frames, log.states, cameras)
    overlay(str(night_dataset), [str(tmp_path / "b.mcap")], tmp_path / "o.mcap", images=True)
    sizes = defaultdict(set)
    for topic, time_ns, image in messages(tmp_path / "o.mcap")["foxglove.CompressedImage"]:
        is_later = time_ns >= half.timestamp() * 1e9
        sizes[topic == "/sat1/image" and is_later].add(struct.unpack(">II", image.data[16:24]))
    assert sizes == {False: {(512, 512)}, True: {(256, 128)}}


def test_what_is_left_out_is_a_line_of_log(written, night_dataset):
    _, made, found = written
    rejects = table(night_dataset, "rejects")
    assert made.log_lines == len(found["foxglove.Log"]) == len(rejects)
    assert [m.name for _, _, m in found["foxglove.Log"]] == rejects["stage"].to_list()


def test_what_has_no_time_is_a_line_of_log_at_the_first_frame(night_log, night_dataset, tmp_path):
    path = shutil.copytree(night_dataset, tmp_path / "out") / f"night={NIGHT}" / "rejects"
    (file,) = path.glob("*.parquet")
    rows = pl.read_parquet(file)
    midnight = pl.lit(datetime.datetime(2019, 4, 1, tzinfo=datetime.UTC))
    untimed = pl.DataFrame([{"reason": "nothing_read", "stage": "read", "count": 1}])
    untimed = untimed.with_columns(time=midnight.cast(rows.schema["time"]))
    with_untimed = pl.concat([untimed, rows], how="diagonal_relaxed").select(rows.columns)
    like = pq.read_schema(file)
    pq.write_table(with_untimed.cast(rows.schema).to_arrow().cast(like), file)
    made = overlay(str(tmp_path / "out"), [str(night_log)], tmp_path / "o.mcap")
    lines = messages(tmp_path / "o.mcap")["foxglove.Log"]
    assert made.log_lines == len(lines) == len(with_untimed)
    first_ns = table(night_dataset, "frames")["time"].dt.timestamp("ns").min()
    assert lines[0][1] == at(lines[0][2].timestamp) == first_ns


def test_the_same_night_gives_the_same_bytes(written, night_log, night_dataset, tmp_path):
    overlay(str(night_dataset), [str(night_log)] * 2, tmp_path / "again.mcap", images=True)
    assert (tmp_path / "again.mcap").read_bytes() == written[0].read_bytes()


def test_without_images_there_are_none(night_log, night_dataset, tmp_path):
    overlay(str(night_dataset), [str(night_log)], tmp_path / "x.mcap")
    assert "foxglove.CompressedImage" not in messages(tmp_path / "x.mcap")


def test_calibrations_are_those_of_the_night(night_log, night_dataset, tmp_path):
    start = datetime.datetime(2019, 4, 2, 4, tzinfo=datetime.UTC)
    simulate("four_sensor_geo", tmp_path / "next.mcap", seed=7, seconds=2, start=start)
    logs = [str(night_log), str(tmp_path / "next.mcap")]
    overlay(str(night_dataset), logs, tmp_path / "x.mcap", night=NIGHT)
    found = messages(tmp_path / "x.mcap")["foxglove.CameraCalibration"]
    days = Counter(str(np.datetime64(time_ns, "ns"))[:10] for _, time_ns, _ in found)
    assert days == {NIGHT: 4}


def test_a_night_that_the_dataset_does_not_have_is_one_line(night_log, night_dataset, tmp_path):
    with pytest.raises(NoFramesError, match=r"has no night of these logs \(2019-04-01\)"):
        overlay(str(tmp_path / "none"), [str(night_log)], tmp_path / "x.mcap")
    with pytest.raises(NoFramesError, match="2019-05-05"):
        overlay(str(night_dataset), [str(night_log)], tmp_path / "x.mcap", night="2019-05-05")
    with pytest.raises(DatasetError, match="cannot be written"):
        overlay(str(night_dataset), [str(night_log)], tmp_path / "no" / "x.mcap")
    assert list(tmp_path.iterdir()) == []


def test_logs_are_read_as_their_run_assumed(night_log, night_dataset, tmp_path):
    log = api.read_log(night_log)
    late = pl.duration(hours=21)
    moved = [rows.with_columns(pl.col("time") + late) for rows in log[:3]]
    api.write_log(tmp_path / "local.mcap", *moved)
    asked = [str(night_dataset), str(tmp_path / "local.mcap"), "--out", str(tmp_path / "x.mcap")]
    refused = CliRunner().invoke(app, ["overlay", *asked])
    assert "give --assume" in refused.output + str(refused.exception)
    ended = CliRunner().invoke(app, ["overlay", *asked, "--assume", "*.ahead_s=75600", "--json"])
    assert ended.exit_code == 0, ended.output
    told = json.loads(ended.stdout)
    assert (told["frames"], told["without_rows"]) == (240, 0)


def test_a_broken_file_in_the_folder_of_the_logs_is_left_out(night_log, night_dataset, tmp_path):
    folder = tmp_path / "logs"
    folder.mkdir()
    (folder / "broken.mcap").write_bytes(b"not a log")
    (folder / "night.mcap").symlink_to(night_log)
    made = overlay(str(night_dataset), [str(folder)], tmp_path / "x.mcap")
    assert (made.frames, made.without_rows) == (240, 0)
    with pytest.raises(LogError, match="is one of the logs, and would be lost"):
        overlay(str(night_dataset), [str(folder)], folder / "broken.mcap")


def test_a_log_is_not_replaced_by_its_overlay(night_log, night_dataset, tmp_path):
    log = tmp_path / "a.mcap"
    shutil.copy(night_log, log)
    (tmp_path / "link.mcap").symlink_to(log)
    for out in (log, tmp_path / "link.mcap"):
        with pytest.raises(LogError, match="is one of the logs, and would be lost"):
            overlay(str(night_dataset), [str(night_log), str(tmp_path)], out)
    assert log.read_bytes() == night_log.read_bytes()


def test_a_night_without_positions_still_has_its_stars(night_log, night_dataset, tmp_path):
    out = shutil.copytree(night_dataset, tmp_path / "out")
    for name in ("positions", "associations", "nights"):
        shutil.rmtree(out / f"night={NIGHT}" / name)
    made = overlay(str(out), [str(night_log)], tmp_path / "x.mcap")
    assert (made.frames, made.epochs) == (240, 0)
    drawn = messages(tmp_path / "x.mcap")["foxglove.ImageAnnotations"]
    assert all(m.circles for _, _, m in drawn)
    assert not any("HIP" in text.text for _, _, m in drawn for text in m.texts)


def test_points_are_the_positions_of_each_epoch(written, night_dataset):
    positions = table(night_dataset, "positions")
    clouds = written[2]["foxglove.PointCloud"]
    assert len(clouds) == positions["epoch"].n_unique()
    for topic, time_ns, cloud in clouds[:3]:
        assert (topic, cloud.frame_id, at(cloud.timestamp)) == ("/epipole/points", "GCRF", time_ns)
        at_epoch = positions.filter(pl.col("epoch").dt.timestamp("ns") == time_ns)
        told_m = np.frombuffer(cloud.data, "<f4").reshape(-1, 3)
        km = at_epoch.select("x_km", "y_km", "z_km").to_numpy()
        np.testing.assert_allclose(told_m, km * 1e3, atol=4.0)


def test_the_layout_has_panels_of_topics_that_are_there(written):
    path, made, found = written
    layout = json.loads(Path(made.layout).read_text())
    topics = {topic for of_schema in found.values() for topic, _, _ in of_schema}
    asked = set()
    for name, panel in layout["configById"].items():
        if name.startswith("Image!"):
            mode = panel["imageMode"]
            asked |= {mode["imageTopic"], mode["calibrationTopic"], *mode["annotations"]}
        elif name.startswith("3D!"):
            asked |= set(panel["topics"])
            assert panel["followTf"] == "GCRF"
        else:
            asked.add(panel["topicToRender"])
    assert asked <= topics | {"/epipole/rejects"}
    assert asked >= {"/sat1/image", "/sat4/annotations", "/epipole/objects"}
    assert sorted(panels_of(layout["layout"])) == sorted(layout["configById"])
    assert Path(made.layout) == path.with_suffix(".layout.json")


def panels_of(layout) -> list[str]:
    if isinstance(layout, str):
        return [layout]
    assert 0 < layout["splitPercentage"] < 100
    return panels_of(layout["first"]) + panels_of(layout["second"])


@pytest.mark.parametrize("count", [0, 1, 2, 9])
def test_any_number_of_sensors_has_a_layout(count):
    layout = viewer_layout([f"s{k}" for k in range(count)])
    assert sorted(panels_of(layout["layout"])) == sorted(layout["configById"])
    assert len(layout["configById"]) == min(count, 4) + 2


def test_the_command_tells_what_it_wrote(night_log, night_dataset, tmp_path):
    asked = ["overlay", str(night_dataset), str(night_log), "--out", str(tmp_path / "x.mcap")]
    ended = CliRunner().invoke(app, asked)
    assert ended.exit_code == 0, ended.output
    assert "frames  240 annotated, " in ended.stdout
    told = json.loads(CliRunner().invoke(app, [*asked, "--json"]).stdout)
    assert told["frames"] == 240

"""Evaluation of datasets: by hand, and against the tool that is independent of this project."""

import importlib.util
import json
import re
import shutil
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from epipole.flows.command_line.main import app
from epipole.flows.evaluate import evaluate, show
from epipole.flows.simulate import simulate
from epipole.io.simulation.truth import Truth, read_truth
from epipole.schemas.bridge import array, concat, empty, table
from epipole.schemas.errors import DatasetError
from epipole.schemas.report import Report
from epipole.schemas.tables import (
    ASSOCIATIONS,
    DETECTIONS,
    EPOCHS,
    FRAMES,
    POSITIONS,
    STARS,
)
from epipole.schemas.work_tables import TRUE_FRAMES, TRUE_POINTS
from epipole.tasks.evaluate.evaluate_dataset import evaluate_dataset

T0_NS = 1_554_091_200_000_000_000
# Circular, in the equator, at its node: at (radius, 0, 0) at t0.
RINGS = [[42164.0, 0.0, 0.0, 0.0, 0.0, 0.0], [42000.0, 0.0, 0.0, 0.0, 0.0, 0.0]]
QUAT = {"qx": 0.0, "qy": 0.0, "qz": 0.0, "qw": 1.0}
STAR, TARGET = 0, 1


def rows(schema, *values):
    """Return a table of these rows; a float that is not given is 0, the rest null or empty."""
    blank = {"double": 0.0, "int64": 0, "int32": 0, "string": "", "bool": True, "int8": 0}
    columns = {}
    for f in schema:
        default = T0_NS if "timestamp" in str(f.type) else blank[str(f.type)]
        columns[f.name] = [v.get(f.name, None if f.nullable else default) for v in values]
    return table(schema, columns)


def little_truth() -> Truth:
    """Two sensors of a frame each, both of which see star 77 and two objects."""
    frames = [{"sensor_id": s, "t_ns": T0_NS, **QUAT} for s in ("a", "b")]
    spots = [(STAR, 77), (TARGET, 0), (TARGET, 1)]
    points = [
        {"sensor_id": s, "centroid": k, "kind": kind, "source": source}
        for s in ("a", "b")
        for k, (kind, source) in enumerate(spots)
    ]
    targets = [{"elements": e} for e in RINGS]
    scenario = {"t0_ns": T0_NS, "sensors": [{"rate_hz": 1.0}] * 2, "targets": targets}
    return Truth(rows(TRUE_FRAMES, *frames), rows(TRUE_POINTS, *points), scenario)


def little_dataset():
    """Object 0 right, 1 km and one sigma off; a ghost of object 1 and a star; one star wrong."""
    half = {"qx": 5e-5, "qw": 1.0}  # a turn by 1e-4 rad about x
    frames = [{"sensor_id": s, "attitude_source": "stars", **QUAT, **half} for s in "ab"]
    stars = [{"sensor_id": "a", "star_id": 77}, {"sensor_id": "b", "star_id": 78}]
    views = [("o1", "a", 1), ("o1", "b", 1), ("o2", "a", 2), ("o2", "b", 0), ("o2", "b", 2)]
    associations = [
        {"object_id": o, "sensor_id": s, "centroid": k, "used": i < 4}
        for i, (o, s, k) in enumerate(views)
    ]
    cov = {"cov_xx": 1.0, "cov_yy": 4.0, "cov_zz": 9.0}
    positions = [{"object_id": "o1", "x_km": 42165.0, **cov}, {"object_id": "o2", **cov}]
    tracked = {"kind": "object", "track_id": "a1", "tracklet_id": "a1"}
    return {
        "frames": rows(FRAMES, *frames),
        "stars": rows(STARS, *stars),
        "detections": rows(
            DETECTIONS, *[{"sensor_id": "a", "centroid": k, **tracked} for k in (1, 2, 0)]
        ),
        "epochs": rows(EPOCHS, {"sensor_id": "a"}, {"sensor_id": "b"}),
        "associations": rows(ASSOCIATIONS, *associations),
        "positions": rows(POSITIONS, *positions),
    }


def test_every_measure_of_a_little_night_is_what_it_is_by_hand():
    found = evaluate_dataset(little_dataset(), little_truth()).as_dict()
    arcsec = 1e-4 * 648000 / np.pi
    assert found.pop("att_cross_arcsec_median") == pytest.approx(arcsec, rel=1e-6)
    assert found.pop("att_cross_arcsec_p99") == pytest.approx(arcsec, rel=1e-6)
    assert found.pop("axis_rms_km") == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    assert found == {
        "frames": 2, "frames_duplicated": 0, "frames_solved": 1.0,
        "stars_claimed": 2, "star_precision": 0.5, "star_recall": 0.5,
        "att_roll_arcsec_median": pytest.approx(0.0, abs=1e-6), "att_wrong": 0,
        "epochs": 1, "groups": 2, "ghosts": 1,
        "pair_precision": 0.5, "pair_recall": 0.5, "object_recall": 0.5,
        "positions": 1, "positions_of_ghosts": 1, "positions_per_truth": 0.5,
        "pos_err_km_median": pytest.approx(1.0), "pos_err_km_p95": pytest.approx(1.0),
        "pos_err_km_max": pytest.approx(1.0),
        "nees_median": pytest.approx(1.0), "nees_in_99": 1.0,
        "ids_per_target": 1.0, "longest_id_share": 1.0,
        "tracks": 1, "track_purity": pytest.approx(1 / 3), "track_completeness": 0.25,
        "tracks_per_target": 1.0,
    }  # fmt: skip


def test_a_missed_view_is_of_what_its_tracklet_is_of():
    tables = little_dataset()
    views = [{"sensor_id": "a", "tracklet_id": "a1"}, {"sensor_id": "b", "centroid": 1}]
    tables["associations"] = rows(ASSOCIATIONS, *[{"object_id": "o1", **view} for view in views])
    found = evaluate_dataset(tables, little_truth())
    assert (found.groups, found.ghosts, found.object_recall) == (1, 0, 0.5)
    assert found.pair_recall == 0.0  # there is no pair of centroids


def test_a_dataset_with_nothing_in_it_has_found_nothing():
    tables = {name: empty(t.schema) for name, t in little_dataset().items()}
    found = evaluate_dataset(tables, little_truth())
    assert (found.frames, found.frames_solved, found.star_recall) == (0, 0.0, 0.0)
    assert (found.object_recall, found.positions, found.tracks) == (0.0, 0, 0)
    assert found.att_wrong is None
    json.dumps(found.as_dict(), allow_nan=False)


def test_without_objects_only_stars_and_attitudes_are_measured():
    truth = little_truth()
    truth.scenario["targets"] = []
    found = evaluate_dataset(little_dataset(), truth)
    assert found.star_precision == 0.5
    assert found.object_recall is None


def test_a_share_is_printed_as_all_only_where_it_is_all():
    printed = [value for _, _, value in Report(star_precision=0.99999, star_recall=1.0).rows()]
    assert printed == ["99.99%", "100.00%"]


def reference():
    """Return the tool beside the repository that shares no code with it."""
    path = Path(__file__).parents[3] / "shared" / "tools" / "evaluate.py"
    if not path.is_file():
        pytest.skip("no ../shared")
    spec = importlib.util.spec_from_file_location("reference_evaluation", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.evaluate


def spoil(dataset: Path, share: float) -> None:
    """Make a share of what the dataset claims wrong, in all the ways it could be."""
    rng = np.random.default_rng(5)

    def change(t, column, change_to):
        hit = rng.random(t.num_rows) < share
        values = [change_to(v) if h else v for v, h in zip(t[column].to_pylist(), hit, strict=True)]
        return put(t, column, pa.array(values, t.schema.field(column).type))

    def mix(t, column):
        values = t[column].to_pylist()
        return change(t, column, lambda _: values[rng.integers(len(values))])

    for part in sorted(dataset.glob("night=*/*/*.parquet")):
        t = pq.read_table(part, partitioning=None)
        match part.parent.name:
            case "frames":
                t = change(t, "attitude_source", lambda _: "prior")
                t = change(t, "qx", lambda v: v + 1e-2)
                t = concat(t.schema, [t, t.slice(0, 3)])
            case "stars":
                t = t.filter(pa.array(rng.random(t.num_rows) >= share))
                t = change(t, "star_id", lambda v: v + 1)
            case "detections":
                for column in ("tracklet_id", "track_id"):
                    t = change(mix(t, column), column, lambda _: None)
                t = change(t, "kind", lambda _: "unknown")
            case "associations":
                t = change(mix(t, "object_id"), "centroid", lambda _: None)
                t = change(t, "tracklet_id", lambda _: None)
                t = change(t, "used", lambda _: False)
            case "positions":
                t = change(mix(t, "object_id"), "cov_xx", lambda v: -v)
                t = change(t, "cov_zz", lambda _: float("nan"))
                # The other tool reads times to microseconds.
                whole = array(t, "time") // 1000 * 1000
                t = put(t, "time", pa.array(whole).cast(t.schema.field("time").type))
        pq.write_table(t, part)


def put(t, column, values):
    at = t.column_names.index(column)
    return t.set_column(at, t.schema.field(column), values)


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5])
def test_it_agrees_with_the_other_tool_number_for_number(share, night_log, night_dataset, tmp_path):
    other = reference()
    dataset = tmp_path / "out"
    shutil.copytree(night_dataset, dataset)
    spoil(dataset, share)
    expected = other(str(dataset), str(night_log))
    found = evaluate(dataset, night_log).as_dict()
    assert set(expected) == set(found)
    if not np.isfinite(expected["nees_median"]):
        expected["nees_median"] = None
    for name, value in expected.items():
        close = None if value is None else pytest.approx(value, rel=1e-9, abs=1e-12)
        assert found[name] == close, name


def test_the_truth_may_be_named_by_its_log_or_its_folder(night_log, night_dataset, capsys):
    by_log, by_folder = (evaluate(night_dataset, f"{night_log}{end}") for end in ("", ".truth"))
    assert by_log == by_folder
    assert by_log.star_precision > 0.99
    show(by_log)
    assert "precision" in capsys.readouterr().out


def test_the_command_line_prints_a_table_or_json(night_log, night_dataset):
    arguments = ["evaluate", str(night_dataset), "--truth", f"{night_log}.truth"]
    printed = CliRunner().invoke(app, arguments)
    assert printed.exit_code == 0
    assert re.search(r"stars +claimed +[\d,]+\n +precision +[\d.]+%\n", printed.output)
    as_json = CliRunner().invoke(app, [*arguments, "--json"])
    assert json.loads(as_json.output) == evaluate(night_dataset, night_log).as_dict()


def test_what_is_not_there_is_one_line_on_the_command_line(night_log, tmp_path):
    gone = CliRunner().invoke(app, ["evaluate", str(tmp_path / "no"), "--truth", str(night_log)])
    assert gone.exit_code == 1
    assert gone.stderr.startswith(f"epipole: {tmp_path}/no: no dataset there; ")
    assert gone.stderr.count("\n") == 1


def test_what_is_not_there_is_said(night_log, tmp_path):
    with pytest.raises(DatasetError, match=r"none: no dataset there; `epipole run"):
        evaluate(tmp_path / "none", night_log)
    (tmp_path / "night=2020-01-01").mkdir()
    with pytest.raises(DatasetError, match=r"has no night=2019-04-01 of this truth"):
        evaluate(tmp_path, night_log)
    with pytest.raises(DatasetError, match=r"no truth folder; `epipole simulate` writes"):
        evaluate(tmp_path, tmp_path / "none.mcap")
    (tmp_path / "x.truth").mkdir()
    with pytest.raises(DatasetError, match=r"frames.parquet: cannot be read as truth"):
        evaluate(tmp_path, tmp_path / "x")


def test_a_truth_over_midnight_is_held_against_both_nights(prefect, tmp_path):
    from epipole.flows.nightly import nightly

    start = datetime(2019, 4, 1, 23, 59, 50, tzinfo=UTC)
    made = simulate("four_sensor_geo", tmp_path / "n.mcap", start=start, hours=20 / 3600)
    nightly([str(log) for log in made.logs], str(tmp_path / "out"))
    assert len(list((tmp_path / "out").glob("night=*"))) == 2
    found = evaluate(tmp_path / "out", made.truth)
    assert found.frames == made.frames == 80
    assert found.star_recall > 0.95
    assert found.object_recall > 0.95


def test_several_logs_of_a_night_have_one_truth(tmp_path):
    made = simulate("four_sensor_geo", tmp_path / "n.mcap", logs=3)
    assert [p.name for p in made.logs] == ["n-1.mcap", "n-2.mcap", "n-3.mcap"]
    assert read_truth(tmp_path / "n.mcap").frames.num_rows == made.frames == 240

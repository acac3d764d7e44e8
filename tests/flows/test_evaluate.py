"""Evaluations of datasets: against an independent tool, and from the command line."""

import importlib.util
import json
import re
import shutil
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from typer.testing import CliRunner

from epipole.flows.command_line.main import app
from epipole.flows.evaluate import evaluate, show
from epipole.flows.simulate import simulate
from epipole.schemas.bridge import array, concat
from epipole.schemas.errors import DatasetError

SHARED = Path(__file__).parents[3] / "shared"
LOGS = [
    "logs/six_sensors_8deg_no_prior.mcap",  # orbits by elements
    "logs_real_orbits/geo_cluster_every_30s.mcap",  # sampled orbits, and the next one
    "logs_real_orbits/low_8deg_5hz.mcap",
]


def reference():
    """Return the tool beside the repository that shares no code with it."""
    path = SHARED / "tools" / "evaluate.py"
    if not path.is_file():
        pytest.skip("no ../shared")
    spec = importlib.util.spec_from_file_location("reference_evaluation", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.evaluate


def compare(expected, found):
    """Require the same measures, number for number. A measure that is not there is null.

    The other tool has fewer of orbits, and of some logs none.
    """
    assert set(expected) <= set(found)
    for name, value in found.items():
        if name.startswith("orbits") and name not in expected:
            continue
        other = expected.get(name)
        if isinstance(other, float) and not np.isfinite(other):  # JSON has no infinity
            other = None
        assert value == (None if other is None else pytest.approx(other, rel=1e-9, abs=1e-12)), name


def spoil(dataset: Path, share: float) -> None:
    """Make a share of what the dataset claims wrong, in all the ways it could be.

    Times are made whole microseconds, because the other tool reads them so.
    """
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
                t = whole_microseconds(t, "time")
            case "states":
                t = change(mix(t, "object_id"), "cov_vxvx", lambda v: -v)
                t = change(t, "object_id", lambda _: "another")
                t = whole_microseconds(t, "epoch")
            case "orbits":
                t = whole_microseconds(t, "epoch")
        pq.write_table(t, part)


def shared_measures(dataset, log):
    """The measures that the other tool has too: none of `observations`, nor of magnitudes."""
    found = evaluate(dataset, log).as_dict()
    left_out = ("observation", "magnitude")
    return {name: value for name, value in found.items() if not name.startswith(left_out)}


def put(t, column, values):
    at = t.column_names.index(column)
    return t.set_column(at, t.schema.field(column), values)


def whole_microseconds(t, column):
    whole = pa.array(array(t, column) // 1000 * 1000)
    return put(t, column, whole.cast(t.schema.field(column).type))


@pytest.mark.parametrize("share", [0.0, 0.1, 0.3])
def test_it_agrees_with_the_other_tool_number_for_number(share, night_log, night_dataset, tmp_path):
    other = reference()
    dataset = tmp_path / "out"
    shutil.copytree(night_dataset, dataset)
    spoil(dataset, share)
    expected, found = other(str(dataset), str(night_log)), shared_measures(dataset, night_log)
    compare(expected, found)


@pytest.mark.long
@pytest.mark.parametrize("log", LOGS)
def test_it_agrees_with_the_other_tool_on_the_shared_logs(log, prefect, tmp_path):
    from epipole.flows.nightly import nightly

    other, log, dataset = reference(), SHARED / "data" / log, tmp_path / "out"
    if not log.is_file():
        pytest.skip(f"no {log.name} in ../shared")
    nightly([str(log)], str(dataset))
    for share in (0.0, 0.2):
        spoil(dataset, share)
        compare(other(str(dataset), str(log)), shared_measures(dataset, log))


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
    assert re.search(r"stars +identified +[\d,]+\n +precision +[\d.]+%\n", printed.output)
    as_json = CliRunner().invoke(app, [*arguments, "--json"])
    assert json.loads(as_json.output) == evaluate(night_dataset, night_log).as_dict()


def test_what_is_not_there_is_one_line_on_the_command_line(night_log, tmp_path):
    gone = CliRunner().invoke(app, ["evaluate", str(tmp_path / "no"), "--truth", str(night_log)])
    assert gone.exit_code == 1
    assert gone.stderr.startswith(f"epipole: {tmp_path}/no: no dataset here; ")
    assert gone.stderr.count("\n") == 1


def test_what_is_not_there_is_said(night_log, tmp_path):
    with pytest.raises(DatasetError, match=r"none: no dataset here; `epipole run"):
        evaluate(tmp_path / "none", night_log)
    (tmp_path / "night=2020-01-01").mkdir()
    with pytest.raises(DatasetError, match=r"has no night=2019-04-01 of this truth"):
        evaluate(tmp_path, night_log)
    with pytest.raises(DatasetError, match=r"no truth folder; `epipole simulate` writes"):
        evaluate(tmp_path, tmp_path / "none.mcap")
    (tmp_path / "x.truth").mkdir()
    with pytest.raises(DatasetError, match=r"frames.parquet, .* missing; give the folder"):
        evaluate(tmp_path, tmp_path / "x")


def test_nights_that_the_dataset_lacks_are_not_held_against_it(
    night_log, night_dataset, tmp_path, caplog
):
    folder = shutil.copytree(f"{night_log}.truth", tmp_path / "two.truth")
    for name in ("frames", "points"):
        path = folder / f"{name}.parquet"
        rows = pl.read_parquet(path)
        later = rows.with_columns(pl.col("frame_number") + 100_000)
        if name == "frames":
            later = later.with_columns(pl.col("t_ns") + 86_400 * 10**9)
        pl.concat([rows, later]).write_parquet(path)
    assert evaluate(night_dataset, folder) == evaluate(night_dataset, night_log)
    assert [record.message for record in caplog.records] == [
        f"{night_dataset}: has no 2019-04-02: not evaluated"
    ]


@pytest.mark.long
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

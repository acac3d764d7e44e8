"""Little memory: the same objects from more and smaller tasks, on any number of workers."""

import contextlib
import datetime
import logging
import tomllib
from collections.abc import Iterator
from pathlib import Path

import polars as pl
import pytest
from prefect.task_runners import ThreadPoolTaskRunner

from epipole.flows.night.progress import STEPS
from epipole.flows.nightly import nightly
from epipole.flows.simulate import simulate
from epipole.schemas.scene import validate_scene
from epipole.schemas.settings import Settings, WorkSettings
from epipole.schemas.stages import Stage
from epipole.schemas.tables import TABLES

NIGHT = "2019-04-01"
FOUR_SENSORS = Path(__file__).parents[2] / "io/simulation/built_in/four_sensor_geo.toml"
LITTLE_MIB = 64
SAME = 1e-6  # sigma

pytestmark = [pytest.mark.long, pytest.mark.usefixtures("prefect")]


class SolveTasks(logging.Handler):
    """The number of tasks of each part of `solve`, as a run reports its progress."""

    def __init__(self) -> None:
        super().__init__()
        self.totals: list[int] = []

    def emit(self, record: logging.LogRecord) -> None:
        counts = vars(record)
        if counts["stage"] == Stage.SOLVE and counts["done"] == 0:
            self.totals.append(counts["total"])


@contextlib.contextmanager
def counted_tasks() -> Iterator[list[int]]:
    handler = SolveTasks()
    STEPS.addHandler(handler)
    try:
        yield handler.totals
    finally:
        STEPS.removeHandler(handler)


def write_log(log: Path, start: str, duration_s: float, rate_hz: float) -> Path:
    """Write a log of four sensors and nine objects."""
    scene = tomllib.loads(FOUR_SENSORS.read_text()) | {"duration_s": duration_s, "seed": 3}
    scene["start"] = datetime.datetime.fromisoformat(f"{NIGHT}T{start}Z")
    scene["sensor_defaults"]["rate_hz"] = rate_hz
    simulate(validate_scene(scene, "night"), log)
    return log


def run(log: Path, out: Path, workers: int = 2, memory_mib: int | None = None) -> list[int]:
    """Run a night; return the number of tasks of each part of `solve`."""
    settings = {"work": {"memory_mib": memory_mib}} if memory_mib else {}
    runner = ThreadPoolTaskRunner(max_workers=workers)
    with counted_tasks() as totals:
        nightly.with_options(task_runner=runner)([str(log)], str(out), settings)
    return totals


def rows(out: Path, table: str) -> pl.DataFrame:
    return pl.read_parquet(f"{out}/night=*/{table}/*.parquet")


def assert_same_objects(one: Path, other: Path) -> None:
    """Assert the same ids and associations, and positions and states within `SAME` sigma."""
    for table in ("frames", "stars", "detections", "epochs", "tracklets", "rejects"):
        assert rows(one, table).equals(rows(other, table)), table
    key = ["epoch", "sensor_id", "frame_number", "x_px", "y_px"]
    ids = [*key, "centroid", "tracklet_id", "object_id", "used"]
    views = [rows(out, "associations").select(ids).sort(key) for out in (one, other)]
    assert len(views[0])
    assert views[0].equals(views[1])
    for table, axes in (
        ("positions", ("x", "y", "z")),
        ("states", ("x", "y", "z", "vx", "vy", "vz")),
    ):
        key = ["epoch", "object_id"]
        both = rows(one, table).join(rows(other, table), on=key, how="full", suffix="_other")
        assert both.null_count().select("epoch", "epoch_other").row(0) == (0, 0), table
        for axis in axes:
            name = f"{axis}_km" + ("_s" if axis.startswith("v") else "")
            sigma = pl.col(f"cov_{axis}{axis}").sqrt()
            sigma_other = pl.col(f"cov_{axis}{axis}_other").sqrt()
            off = both.select(
                ((pl.col(name) - pl.col(f"{name}_other")) / sigma).abs().max().alias("off"),
                (sigma_other / sigma - 1).abs().max().alias("sigma"),
            )
            for found in off.row(0):
                assert (found or 0.0) <= SAME, (table, axis, off)


@pytest.fixture(scope="module")
def log(tmp_path_factory) -> Path:
    """More views than little memory holds, over the border of two blocks."""
    return write_log(tmp_path_factory.mktemp("log") / "night.mcap", "04:09:30", 60.0, 20.0)


@pytest.fixture(scope="module")
def with_little(prefect, log, tmp_path_factory) -> Path:
    """The dataset of `log`, made with little memory by one worker."""
    out = tmp_path_factory.mktemp("little") / "out"
    assert run(log, out, 1, LITTLE_MIB) == [4, 3, 1, 1, 2]  # views, blocks, numbers, spans, pieces
    return out


def test_little_memory_gives_the_same_objects(log, with_little, tmp_path):
    assert len(rows(with_little, "associations")) > WorkSettings(memory_mib=LITTLE_MIB).max_views
    out = tmp_path / "out"
    assert run(log, out) == [1, 1, 1, 1, 1]
    assert rows(out, "states").height == 9
    assert_same_objects(out, with_little)


def test_little_memory_gives_the_same_bits_with_any_number_of_workers(log, with_little, tmp_path):
    run(log, tmp_path / "out", 2, LITTLE_MIB)
    for table in TABLES:
        assert rows(tmp_path / "out", table).equals(rows(with_little, table)), table


def test_an_object_a_task_over_the_border_of_two_spans_gives_the_same_objects(
    tmp_path, monkeypatch
):
    log = write_log(tmp_path / "night.mcap", "04:29:40", 40.0, 1.0)
    assert run(log, tmp_path / "out") == [2, 2, 1, 2, 2]
    monkeypatch.setattr("epipole.schemas.settings.BYTES_PER_VIEW", 6_000_000)
    assert Settings().work.max_views < 100
    # A task per sensor, block and object, in each of the two spans.
    assert run(log, tmp_path / "small") == [8, 6, 1, 2, 18]
    assert rows(tmp_path / "out", "positions")["object_id"].n_unique() == 9
    assert_same_objects(tmp_path / "out", tmp_path / "small")

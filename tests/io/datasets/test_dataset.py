"""Publishing: whole nights or nothing, the same rows every time, nothing else touched."""

import errno
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import polars as pl
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from scenes.dataset_tables import (
    NEXT_NIGHT,
    NIGHT,
    OVER_MIDNIGHT,
    TIMES,
    contents,
    night_tables,
)
from scenes.published import publish

from epipole.io.datasets import local
from epipole.io.datasets import night_tables as night_files
from epipole.io.datasets.dataset import (
    check_folder,
    lock_nights,
    publish_folders,
    read_table,
    write_beside,
)
from epipole.schemas.bridge import from_polars
from epipole.schemas.columns import TIME
from epipole.schemas.errors import DatasetError
from epipole.schemas.tables import TABLES

WHOLE_NIGHT = {"sources", "nights", "calibrations", "identifications", "objects", "sensor_errors",
               "checks"}  # fmt: skip


def test_every_table_has_a_file_each_night_with_its_units(tmp_path):
    publish(tmp_path / "out", {"sources": night_tables(TIMES)["sources"]}, [NIGHT])
    for name, schema in TABLES.items():
        stored = pq.read_schema(tmp_path / f"out/night={NIGHT}/{name}/part-0.parquet")
        assert stored.equals(schema, check_metadata=True)
    assert read_table(tmp_path / "out", "positions", NIGHT).num_rows == 0
    assert read_table(tmp_path / "out", "sources", NIGHT).num_rows == 1


def test_polars_reads_the_dataset_by_night(tmp_path):
    publish(tmp_path, night_tables(OVER_MIDNIGHT), [NIGHT, NEXT_NIGHT])
    scan = pl.scan_parquet(f"{tmp_path}/night=*/positions/*.parquet", hive_partitioning=True)
    counts = scan.group_by("night").len().sort("night").collect()
    assert counts["len"].to_list() == [10, 10]


def test_only_night_folders_are_left_behind(tmp_path):
    publish(tmp_path / "out", night_tables(TIMES), [NIGHT])
    assert [p.name for p in (tmp_path / "out").iterdir()] == [f"night={NIGHT}"]


def test_rows_go_to_the_night_of_their_time_in_order_of_time(tmp_path):
    shuffled = np.random.default_rng(3).permutation(OVER_MIDNIGHT)
    publish(tmp_path, night_tables(shuffled), [NIGHT, NEXT_NIGHT])
    found = []
    for name in set(TABLES) - WHOLE_NIGHT:
        nights = [read_table(tmp_path, name, night) for night in (NIGHT, NEXT_NIGHT)]
        assert [t.num_rows for t in nights] == [10, 10], name
        column = next(f.name for f in nights[0].schema if f.type == TIME)
        found = np.concatenate([t[column].cast(pa.int64()).to_numpy() for t in nights])
        np.testing.assert_array_equal(found, OVER_MIDNIGHT)


def test_a_restricted_run_writes_its_night_only(tmp_path):
    publish(tmp_path, night_tables(OVER_MIDNIGHT), [NEXT_NIGHT])
    assert [p.name for p in tmp_path.iterdir()] == [f"night={NEXT_NIGHT}"]


def test_publishing_again_gives_the_same_bytes_and_leaves_other_nights_alone(tmp_path):
    publish(tmp_path, night_tables(OVER_MIDNIGHT), [NIGHT, NEXT_NIGHT])
    before = contents(tmp_path)
    shuffled = {
        name: table.take(np.random.default_rng(1).permutation(table.num_rows))
        for name, table in night_tables(OVER_MIDNIGHT).items()
    }
    publish(tmp_path, shuffled, [NIGHT])
    after = contents(tmp_path)
    # These have no time and made-up rows that share a sensor: their order is the run's.
    for part in [p for p in before if "/calibrations/" in p or "/checks/" in p]:
        before.pop(part), after.pop(part)
    assert after == before


def test_a_published_night_replaces_the_old_one_whole(tmp_path):
    publish(tmp_path, night_tables(TIMES), [NIGHT])
    publish(tmp_path, night_tables(TIMES[:5], seed=1), [NIGHT])
    assert read_table(tmp_path, "positions", NIGHT).num_rows == 5
    assert len(list(tmp_path.rglob("*.parquet"))) == len(TABLES)


def test_a_run_without_a_recorded_log_is_refused_and_names_it(tmp_path):
    publish(tmp_path, night_tables(TIMES, ("a", "b")), [NIGHT])
    before = contents(tmp_path)
    with pytest.raises(DatasetError, match=r"night=2019-04-01: was also made from b\.mcap"):
        publish(tmp_path, night_tables(TIMES, ("a", "c")), [NIGHT])
    assert contents(tmp_path) == before
    publish(tmp_path, night_tables(TIMES, ("a", "c")), [NIGHT], replace=True)
    assert read_table(tmp_path, "sources", NIGHT)["name"].to_pylist() == ["a.mcap", "c.mcap"]


def _logs(*logs: tuple[str, int, str], times: np.ndarray = TIMES) -> dict[str, pa.Table]:
    """Return tables of a night from logs, each of a name, a size and what makes its digest."""
    tables = night_tables(times, tuple(digest for *_, digest in logs))
    sources = pl.from_arrow(tables["sources"]).with_columns(
        name=pl.Series([name for name, *_ in logs]), size=pl.Series([size for _, size, _ in logs])
    )
    return tables | {"sources": from_polars(TABLES["sources"], sources)}


# Two folders have a log of this name each.
BOTH = ("night.mcap", 467, "a"), ("night.mcap", 462, "b")


@pytest.mark.parametrize(
    "given",
    [
        BOTH[:1],  # recorded itself: it is no later form of the other one
        BOTH[1:],
        [BOTH[0], ("night.mcap", 461, "c")],  # has become smaller
        [("night.mcap", 468, "c")],  # one changed log is not both
        [("night.mcap", 463, "c"), ("night.mcap", 466, "d")],
    ],
)
def test_a_log_of_the_same_name_does_not_stand_for_a_missing_one(tmp_path, given):
    publish(tmp_path, _logs(*BOTH), [NIGHT])
    before = contents(tmp_path)
    with pytest.raises(DatasetError, match=r"was also made from night\.mcap;"):
        publish(tmp_path, _logs(*given), [NIGHT])
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    "given",
    [
        [BOTH[1], ("night.mcap", 468, "c")],
        [("night.mcap", 463, "c"), ("night.mcap", 468, "d")],
        [("night.mcap", 468, "d"), ("night.mcap", 462, "c"), ("night.mcap", 467, "e")],
    ],
)
def test_logs_of_one_name_that_have_grown_replace_their_night(tmp_path, given):
    publish(tmp_path, _logs(*BOTH), [NIGHT])
    publish(tmp_path, _logs(*given), [NIGHT])
    assert read_table(tmp_path, "sources", NIGHT).num_rows == len(given)


def test_a_log_that_another_night_of_the_run_records_is_no_later_form_of_a_missing_one(tmp_path):
    publish(tmp_path, _logs(BOTH[1]), [NIGHT])
    publish(tmp_path, _logs(BOTH[0], times=OVER_MIDNIGHT), [NEXT_NIGHT])
    with pytest.raises(DatasetError, match=r"night=2019-04-01: was also made from night\.mcap;"):
        publish(tmp_path, _logs(BOTH[0], times=OVER_MIDNIGHT), [NIGHT, NEXT_NIGHT])


def test_one_refused_night_stops_all_nights_of_the_run(tmp_path):
    publish(tmp_path, night_tables(OVER_MIDNIGHT, ("b",)), [NEXT_NIGHT])
    before = contents(tmp_path)
    with pytest.raises(DatasetError, match=r"night=2019-04-02.*b\.mcap"):
        publish(tmp_path, night_tables(OVER_MIDNIGHT, ("a",)), [NIGHT, NEXT_NIGHT])
    assert contents(tmp_path) == before


def test_a_log_belongs_to_the_nights_it_has_frames_in(tmp_path):
    tables = night_tables(OVER_MIDNIGHT)
    early = night_tables(TIMES, ("b",))["sources"]
    tables["sources"] = pa.concat_tables([tables["sources"], early])
    publish(tmp_path, tables, [NIGHT, NEXT_NIGHT])
    names = [read_table(tmp_path, "sources", n)["name"].to_pylist() for n in (NIGHT, NEXT_NIGHT)]
    assert names == [["b.mcap", "a.mcap"], ["a.mcap"]]


def test_a_folder_of_other_things_is_refused(tmp_path):
    (tmp_path / "holiday.jpg").write_text("")
    with pytest.raises(DatasetError, match="holds other files and no dataset"):
        publish(tmp_path, night_tables(TIMES), [NIGHT])
    with pytest.raises(DatasetError, match="is a file"):
        check_folder(tmp_path / "holiday.jpg")
    assert [p.name for p in tmp_path.iterdir()] == ["holiday.jpg"]


def _disk_full(*_args, **_kwargs):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("there_before", [False, True])
def test_a_full_disk_leaves_the_dataset_as_it_was(tmp_path, monkeypatch, there_before):
    out = tmp_path / "out"
    if there_before:
        publish(out, night_tables(TIMES), [NIGHT])
    before = contents(tmp_path)
    monkeypatch.setattr(night_files, "_write", _disk_full)
    with pytest.raises(DatasetError, match="No space left on device"):
        publish(out, night_tables(TIMES[:5]), [NIGHT])
    assert contents(tmp_path) == before
    assert out.exists() == there_before


@pytest.mark.parametrize("exchange_supported", [True, False])
def test_a_failure_at_the_second_night_takes_the_first_back(
    tmp_path, monkeypatch, exchange_supported
):
    publish(tmp_path, night_tables(OVER_MIDNIGHT), [NIGHT])
    before = contents(tmp_path)
    if not exchange_supported:
        monkeypatch.setattr(local, "exchange", lambda *_: False)
    put_in_place = local.put_in_place

    def fails_at_second(new, target, old):
        if target.name == f"night={NEXT_NIGHT}":
            _disk_full()
        put_in_place(new, target, old)

    monkeypatch.setattr(local, "put_in_place", fails_at_second)
    with pytest.raises(DatasetError):
        publish(tmp_path, night_tables(OVER_MIDNIGHT, seed=9), [NIGHT, NEXT_NIGHT])
    assert contents(tmp_path) == before


@pytest.mark.parametrize("exchange_supported", [True, False])
def test_what_could_not_be_published_is_still_staged_for_another_try(
    tmp_path, monkeypatch, exchange_supported
):
    out, nights = tmp_path / "out", [NIGHT, NEXT_NIGHT]
    publish(out, night_tables(OVER_MIDNIGHT, seed=9), nights)
    publish(tmp_path / "new", night_tables(OVER_MIDNIGHT), nights)
    new = contents(tmp_path / "new")
    sources = night_tables(OVER_MIDNIGHT)["sources"]
    if not exchange_supported:
        monkeypatch.setattr(local, "exchange", lambda *_: False)
    with lock_nights(out, nights) as work:
        for night in nights:
            shutil.copytree(tmp_path / "new" / f"night={night}", work / f"night={night}")
        staged = {night: work / f"night={night}" for night in nights}
        with monkeypatch.context() as patch:
            patch.setattr(local, "sync", lambda path: _disk_full() if path == out else None)
            with pytest.raises(DatasetError):
                publish_folders(out, staged, sources)
        assert contents(work) == new | {"claim": (work / "claim").read_bytes()}
        publish_folders(out, staged, sources)
    assert contents(out) == new


def test_without_exchange_two_renames_do(tmp_path, monkeypatch):
    monkeypatch.setattr(local, "exchange", lambda *_: False)
    publish(tmp_path, night_tables(TIMES), [NIGHT])
    publish(tmp_path, night_tables(TIMES[:5]), [NIGHT])
    assert read_table(tmp_path, "frames", NIGHT).num_rows == 5
    assert [p.name for p in tmp_path.iterdir()] == [f"night={NIGHT}"]


def test_what_a_killed_run_left_is_cleared_and_a_night_it_had_taken_goes_back(tmp_path):
    publish(tmp_path, night_tables(TIMES), [NIGHT])
    (tmp_path / ".staging/run-12345" / f"night={NEXT_NIGHT}" / "frames").mkdir(parents=True)
    (tmp_path / ".staging/swap-12345").mkdir()
    (tmp_path / f"night={NIGHT}").rename(tmp_path / f".staging/swap-12345/old-night={NIGHT}")
    publish(tmp_path, night_tables(OVER_MIDNIGHT), [NEXT_NIGHT])
    assert sorted(p.name for p in tmp_path.iterdir()) == [f"night={NIGHT}", f"night={NEXT_NIGHT}"]
    assert read_table(tmp_path, "frames", NIGHT).num_rows == len(TIMES)


def _publish_many(folder: Path, seed: int) -> None:
    times = TIMES[: 10 + seed]
    for _ in range(8):
        publish(folder, night_tables(times, seed=seed), [NIGHT])


def test_two_runs_at_once_publish_whole_nights_and_a_reader_never_misses_one(tmp_path):
    publish(tmp_path, night_tables(TIMES[:10]), [NIGHT])
    parts = [tmp_path / f"night={NIGHT}" / name / "part-0.parquet" for name in TABLES]
    missed = []
    with ThreadPoolExecutor(2) as pool:  # a lock is of an open file, so threads exclude each other
        runs = [pool.submit(_publish_many, tmp_path, seed) for seed in (1, 2)]
        while not all(run.done() for run in runs):
            missed += [part for part in parts if not part.exists()]
    for run in runs:
        run.result()
    assert missed == []
    assert read_table(tmp_path, "frames", NIGHT).num_rows in (11, 12)
    assert [p.name for p in tmp_path.iterdir()] == [f"night={NIGHT}"]


def test_a_staging_folder_that_goes_while_it_is_made_is_made_again(tmp_path, monkeypatch):
    staging, is_dir = tmp_path / ".staging", Path.is_dir

    def removed_first(path: Path) -> bool:
        if path == staging and not any(staging.iterdir()):
            staging.rmdir()
            monkeypatch.undo()
        return is_dir(path)

    staging.mkdir()
    monkeypatch.setattr(Path, "is_dir", removed_first)
    publish(tmp_path, night_tables(TIMES), [NIGHT])
    assert Path.is_dir is is_dir
    assert [p.name for p in tmp_path.iterdir()] == [f"night={NIGHT}"]


def test_a_task_that_was_killed_as_it_wrote_writes_its_table_anew(tmp_path):
    rows = night_tables(TIMES)["frames"]
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames/part-0.parquet").write_bytes(b"PAR1 half a file")
    assert night_files.write_table(tmp_path, "frames", [rows]) == rows.num_rows
    assert pq.read_table(tmp_path / "frames/part-0.parquet", partitioning=None).num_rows == len(
        TIMES
    )


def test_a_file_in_the_place_of_the_staging_folder_is_named(tmp_path):
    (tmp_path / ".staging").write_text("")
    with pytest.raises(DatasetError, match="File exists"):
        publish(tmp_path, night_tables(TIMES), [NIGHT])


def test_a_damaged_night_is_named(tmp_path):
    publish(tmp_path, night_tables(TIMES), [NIGHT])
    (tmp_path / f"night={NIGHT}/sources/part-0.parquet").write_bytes(b"not parquet")
    with pytest.raises(DatasetError, match="remove the folder of the night"):
        publish(tmp_path, night_tables(TIMES), [NIGHT])


def test_a_file_beside_the_nights_that_cannot_be_written_leaves_nothing(tmp_path):
    with pytest.raises(DatasetError, match="cannot be written"):
        write_beside(tmp_path, "reports", "x" * 300, b"text")
    assert list((tmp_path / "reports").iterdir()) == []

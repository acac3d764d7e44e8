"""Nights that a run has claimed: refused to others, free again however the run ends."""

import subprocess
import sys

import pytest
from scenes.dataset_tables import NEXT_NIGHT, NIGHT, TIMES, night_tables
from scenes.published import publish

from epipole.io.datasets.dataset import claim_nights, publish_folders, read_table
from epipole.schemas.errors import DatasetError
from epipole.schemas.tables import TABLES

# Claims a night, leaves something in its folder, and waits to be killed.
HOLD = """
import sys
from epipole.io.datasets.dataset import claim_nights
with claim_nights(sys.argv[1], [sys.argv[2]]) as work:
    (work / "half").mkdir()
    print(work, flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holding(tmp_path):
    """Return a process that has claimed NIGHT, and its folder."""
    command = [sys.executable, "-c", HOLD, str(tmp_path / "out"), NIGHT]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=tmp_path
    ) as process:
        yield process, process.stdout.readline().strip()
        process.kill()


def test_a_second_run_of_a_night_is_refused_and_told_of_the_first(tmp_path):
    with claim_nights(tmp_path / "out", [NIGHT, NEXT_NIGHT]):
        with (
            pytest.raises(DatasetError, match=rf"night={NEXT_NIGHT}: process \d+ on .* since 20"),
            claim_nights(tmp_path / "out", [NEXT_NIGHT]),
        ):
            pytest.fail("two runs of one night")
        with claim_nights(tmp_path / "out", ["2019-04-09"]):
            pass
    with claim_nights(tmp_path / "out", [NIGHT]):
        pass
    assert not (tmp_path / "out").exists()


def test_a_run_of_another_process_is_refused_until_it_is_killed(tmp_path, holding):
    process, work = holding
    with (
        pytest.raises(DatasetError, match=rf"process {process.pid} on"),
        claim_nights(tmp_path / "out", [NIGHT]),
    ):
        pytest.fail("two runs of one night")
    process.kill()
    process.wait()
    with claim_nights(tmp_path / "out", [NIGHT]) as own:
        assert [p.name for p in own.parent.glob("run-*")] == [own.name]  # the dead one's is gone
        assert not own.parent.joinpath(work).exists()


def test_what_a_living_run_has_staged_is_not_touched_by_others(tmp_path, holding):
    process, _ = holding
    publish(tmp_path / "out", night_tables(TIMES), [NIGHT])
    assert list((tmp_path / "out").glob(".staging/run-*/half"))
    process.communicate()
    assert [p.name for p in (tmp_path / "out").iterdir()] == [f"night={NIGHT}"]


def test_folders_are_put_in_place_while_their_nights_are_claimed(tmp_path):
    publish(tmp_path / "other", night_tables(TIMES), [NIGHT])
    with claim_nights(tmp_path / "out", [NIGHT]) as work:
        (tmp_path / "other" / f"night={NIGHT}").rename(work / "made")
        publish_folders(tmp_path / "out", {NIGHT: work / "made"}, night_tables(TIMES)["sources"])
        assert read_table(tmp_path / "out", "frames", NIGHT).num_rows == len(TIMES)
    assert [p.name for p in (tmp_path / "out").iterdir()] == [f"night={NIGHT}"]


def test_a_folder_that_lacks_a_table_is_never_a_night(tmp_path):
    with claim_nights(tmp_path / "out", [NIGHT]) as work:
        for name in TABLES:
            (work / "made" / name).mkdir(parents=True)
        with pytest.raises(ValueError, match="not a whole night"):
            publish_folders(
                tmp_path / "out", {NIGHT: work / "made"}, night_tables(TIMES)["sources"]
            )
    assert not (tmp_path / "out").exists()


def test_an_error_in_a_run_leaves_nothing_behind(tmp_path):
    def run():
        with claim_nights(tmp_path / "out", [NIGHT]) as work:
            (work / "half").mkdir()
            raise RuntimeError

    with pytest.raises(RuntimeError):
        run()
    assert not (tmp_path / "out").exists()

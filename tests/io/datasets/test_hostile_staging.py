"""Files that an attacker has put into a dataset: nothing outside it is moved, read or written.

The attacker may write to the dataset. The victim, who may do more, only looks at it.
"""

import fcntl
import json
import os

import pytest
from scenes.dataset_tables import NIGHT, TIMES, contents, night_tables
from scenes.published import publish
from typer.testing import CliRunner

from epipole.flows.command_line.main import app
from epipole.io.datasets.dataset import lock_nights, write_beside
from epipole.io.datasets.object_store import store_nights
from epipole.io.datasets.plain_files import MAX_BYTES
from epipole.io.work.folder import work_folder
from epipole.io.work.recipe import recipe_of
from epipole.schemas.errors import DatasetError
from epipole.schemas.settings import Settings


@pytest.fixture
def dataset(tmp_path):
    """Return a dataset of one night, beside a folder `secret` that is none of its business."""
    publish(tmp_path / "out", night_tables(TIMES), [NIGHT])
    (tmp_path / "secret").mkdir()
    (tmp_path / "secret" / "key").write_text("private")
    (tmp_path / "out" / ".staging" / "swap-0").mkdir(parents=True)
    (tmp_path / "out" / ".staging" / "run-0").mkdir()
    return tmp_path / "out"


def commit(dataset, folder, night=NIGHT, of=None):
    """Write a commit that makes a folder a night."""
    inode = os.stat(of or dataset.parent / "secret").st_ino
    text = json.dumps({night: {"folder": str(folder), "inode": inode}})
    (dataset / ".staging" / "swap-0" / "commit.json").write_text(text)


def by_dots(dataset):
    commit(dataset, "../../../secret")


def by_an_absolute_path(dataset):
    commit(dataset, dataset.parent / "secret")


def by_a_night_that_leads_out(dataset):
    (dataset / "night=x").mkdir()
    (dataset / ".staging" / "run-0" / "evil").mkdir()
    commit(dataset, "../run-0/evil", "x/../../secret", dataset / ".staging" / "run-0" / "evil")


def by_dots_in_the_run(dataset):
    commit(dataset, "../run-0/../../../secret")


def by_a_run_that_is_a_link(dataset):
    (dataset / ".staging" / "run-1").symlink_to(dataset.parent)
    commit(dataset, "../run-1/secret")


def by_a_night_that_is_a_link(dataset):
    (dataset / f"night={NIGHT}").rename(dataset / "aside")
    (dataset / f"night={NIGHT}").symlink_to(dataset.parent / "secret")
    (dataset / ".staging" / "run-0" / "evil").mkdir()
    commit(dataset, "../run-0/evil", of=dataset / ".staging" / "run-0" / "evil")


def by_a_commit_that_is_a_link(dataset):
    by_dots(dataset)
    real = dataset.parent / "commit"
    (dataset / ".staging" / "swap-0" / "commit.json").rename(real)
    (dataset / ".staging" / "swap-0" / "commit.json").symlink_to(real)


def by_a_commit_that_is_a_pipe(dataset):
    os.mkfifo(dataset / ".staging" / "swap-0" / "commit.json")


def by_a_lock_that_is_a_link(dataset):
    (dataset / ".staging" / "run-0" / "evil").mkdir()
    commit(dataset, "../run-0/evil", of=dataset / ".staging" / "run-0" / "evil")
    (dataset / ".staging" / "lock").symlink_to(dataset.parent / "secret" / "key")


def written(content):
    def write(dataset):
        (dataset / ".staging" / "swap-0" / "commit.json").write_bytes(content)

    return write


ATTACKS = {
    attack.__name__: attack
    for attack in (
        by_dots, by_an_absolute_path, by_a_night_that_leads_out, by_dots_in_the_run,
        by_a_run_that_is_a_link, by_a_night_that_is_a_link, by_a_commit_that_is_a_link,
        by_a_commit_that_is_a_pipe, by_a_lock_that_is_a_link,
    )
} | {
    "binary": written(b"\xff\xfe\x00\x9c{"),
    "deep": written(b"[" * 100_000),
    "huge": written(b" " * MAX_BYTES + b"{}"),
    "a number": written(b"7"),
    "a number for a folder": written(json.dumps({NIGHT: {"folder": 7, "inode": 7}}).encode()),
    "an odd date": written(json.dumps({"2019-4-1": {"folder": "../run-0/a", "inode": 7}}).encode()),
}  # fmt: skip


@pytest.mark.parametrize("attack", ATTACKS.values(), ids=ATTACKS)
def test_a_command_that_reads_ends_in_one_line_and_changes_nothing(attack, dataset):
    attack(dataset)
    root = dataset.parent
    before = contents(root)
    ended = CliRunner().invoke(app, ["nights", str(dataset)])
    assert ended.exit_code == 1
    assert ended.stderr.startswith(f"epipole: {dataset}/")
    assert "remove it" in ended.stderr
    assert ended.stderr.count("\n") == 1
    (dataset / ".staging" / "lock").unlink(missing_ok=True)
    before.pop("out/.staging/lock", None)
    assert contents(root) == before


def test_what_a_reader_finishes_it_says_and_leaves_the_rest(dataset, caplog):
    new = dataset / ".staging" / "run-0" / f"night={NIGHT}"
    publish(dataset.parent / "other", night_tables(TIMES[:5]), [NIGHT])
    (dataset.parent / "other" / f"night={NIGHT}").rename(new)
    commit(dataset, f"../run-0/night={NIGHT}", of=new)
    (dataset / ".staging" / "run-2").mkdir()  # of a killed run: the next run removes it
    ended = CliRunner().invoke(app, ["nights", str(dataset)])
    assert ended.exit_code == 0
    assert f"finished the publication of {NIGHT}" in caplog.text
    assert (dataset / ".staging" / "run-2").is_dir()
    assert not new.exists()


@pytest.mark.parametrize(
    "change",
    [
        {"nights": 7}, {"nights": ["../x"]}, {"nights": [7]}, {"pid": "7"}, {"pid": None},
        {"host": 7}, {"token": ["a"]}, {"since": {}},
    ],
)  # fmt: skip
def test_a_lock_of_odd_content_is_named(change, dataset):
    record = {"nights": [], "host": "", "pid": 1, "since": "", "machine": "", "token": ""} | change
    (dataset / ".staging" / "run-0" / "claim").write_text(json.dumps(record))
    with (dataset / ".staging" / "run-0" / "claim").open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with (
            pytest.raises(DatasetError, match=r"claim: is not the lock of a run; remove it"),
            lock_nights(dataset, [NIGHT]),
        ):
            pytest.fail("an odd lock")


def test_a_work_folder_or_reports_that_are_links_are_not_written_to(dataset):
    recipe = recipe_of("", Settings())
    name = f"work-{NIGHT}-{recipe.made_with}-{recipe.work_key(NIGHT)}"
    (dataset / ".staging" / name).symlink_to(dataset.parent / "secret")
    with (
        pytest.raises(DatasetError, match="is a symbolic link; remove it"),
        work_folder(dataset / ".staging", NIGHT, recipe),
    ):
        pytest.fail("a link")
    (dataset / "reports").symlink_to(dataset.parent / "secret")
    with pytest.raises(DatasetError, match="is a symbolic link; remove it"):
        write_beside(dataset, "reports", f"{NIGHT}.html", b"text")
    assert [path.name for path in (dataset.parent / "secret").iterdir()] == ["key"]


@pytest.mark.parametrize(
    "change",
    [
        {"staged": ""}, {"staged": ".."}, {"staged": "run-x/../.."}, {"staged": 7}, {"files": 7},
        {"files": {"x/../..": []}}, {"files": {NIGHT: ["../../a.parquet"]}},
        {"files": {NIGHT: ["frames/../../a.parquet"]}}, {"files": {NIGHT: 7}},
    ],
)  # fmt: skip
def test_a_commit_in_a_store_names_nothing_outside_its_nights(change):
    import fsspec

    memory = fsspec.filesystem("memory")
    whole = {"staged": f"run-{'0' * 32}", "files": {NIGHT: ["frames/part-0.parquet"]}}
    out = "memory://hostile/ds"
    memory.pipe_file(f"{out}/.staging/commit-0.json", json.dumps(whole).encode())
    assert store_nights(out).nights() == [NIGHT]
    memory.pipe_file(f"{out}/.staging/commit-0.json", json.dumps(whole | change).encode())
    with pytest.raises(DatasetError, match="is not a commit of a run; remove it"):
        store_nights(out).nights()
    memory.rm("/hostile", recursive=True)


def test_folders_that_are_no_nights_are_not_shown_as_nights(dataset):
    for name in ("x", "2019-4-1", "0001-01-01", "9999-12-31", "2019-02-30"):
        (dataset / f"night={name}").mkdir()
    (dataset / "night=2019-05-01").touch()
    ended = CliRunner().invoke(app, ["nights", str(dataset), "--json"])
    assert ended.exit_code == 0
    assert [night["night"] for night in json.loads(ended.stdout)["nights"]] == [NIGHT]

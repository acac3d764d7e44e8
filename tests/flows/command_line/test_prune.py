"""`epipole prune`: what it shows, and what it removes when asked to."""

import json
import shutil

import pytest
from scenes.dataset_tables import TIMES, night_tables
from scenes.published import publish
from typer.testing import CliRunner

from epipole.flows.command_line.main import app
from epipole.io.datasets.dataset import lock_nights, nights_in
from epipole.io.datasets.object_store import StoreNights
from epipole.schemas.errors import DatasetError

NIGHT, NEXT = "2019-04-01", "2019-04-02"


@pytest.fixture
def dataset(night_dataset, tmp_path):
    """Return a dataset of two nights, each with a report and the record of a run."""
    out = shutil.copytree(night_dataset, tmp_path / "out")
    shutil.copytree(out / f"night={NIGHT}", out / f"night={NEXT}")
    for folder, suffix in (("reports", "html"), ("runs", "parquet")):
        (out / folder).mkdir(exist_ok=True)
        for night in (NIGHT, NEXT):
            (out / folder / f"{night}.{suffix}").write_bytes(bytes(2**20))
    return out


def prune(*arguments, code: int = 0) -> str:
    ended = CliRunner().invoke(app, ["prune", *map(str, arguments)])
    assert ended.exit_code == code, ended.output
    return ended.output


def test_it_shows_first_and_removes_on_request(dataset):
    shown = prune(dataset, "--nights", NEXT)
    for name in (f"night={NIGHT}", f"reports/{NIGHT}.html", f"runs/{NIGHT}.parquet"):
        assert f"MiB  {name}\n" in shown
    assert NEXT not in shown
    assert "would be removed; --yes does it" in shown
    assert nights_in(str(dataset)) == [NIGHT, NEXT]
    assert shown.replace("would be removed; --yes does it", "removed") == prune(
        dataset, "--nights", NEXT, "--yes"
    )
    assert nights_in(str(dataset)) == [NEXT]
    left = {str(f.relative_to(dataset)) for f in dataset.glob("r*/*.*")}
    assert left >= {f"reports/{NEXT}.html", f"runs/{NEXT}.parquet"}
    assert not any(NIGHT in name for name in left)
    assert not (dataset / ".staging").exists()
    assert prune(dataset, "--nights", NEXT) == "nothing to remove\n"


def test_reports_alone(dataset):
    prune(dataset, "--reports", "2020-01-01", "--yes")
    assert nights_in(str(dataset)) == [NIGHT, NEXT]
    assert list((dataset / "reports").iterdir()) == []


def test_a_night_on_which_a_run_works_stays_and_the_others_go(dataset):
    with lock_nights(str(dataset), [NEXT]):
        said = prune(dataset, "--nights", "2020-01-01", "--yes")
        told = json.loads(prune(dataset, "--nights", "2020-01-01", "--json"))
    assert f"night={NEXT} stays: a run works on it\n" in said
    assert f"night={NIGHT}\n" in said
    assert told == {"removed": False, "bytes": {}, "locked": [NEXT]}
    assert nights_in(str(dataset)) == [NEXT]
    left = {str(f.relative_to(dataset)) for f in dataset.glob("r*/*.*")}
    assert left >= {f"reports/{NEXT}.html", f"runs/{NEXT}.parquet"}
    assert not any(NIGHT in name for name in left)


def test_a_night_that_is_locked_meanwhile_is_not_removed(dataset, monkeypatch):
    monkeypatch.setattr("epipole.io.datasets.dataset.locked_nights", lambda _: set())
    with lock_nights(str(dataset), [NIGHT]):
        said = prune(dataset, "--nights", NEXT, "--yes", code=1)
    assert "has worked on it since" in said
    assert nights_in(str(dataset)) == [NIGHT, NEXT]


def test_a_night_that_a_stopped_run_has_published_does_not_come_back(monkeypatch):
    out = "memory://pruned/ds"

    def stop(*_):
        raise PermissionError("stopped")

    with monkeypatch.context() as patched:
        patched.setattr(StoreNights, "_finish", stop)
        with pytest.raises(DatasetError, match="published, but not all files are in place"):
            publish(out, night_tables(TIMES), [NIGHT])
    assert nights_in(out) == [NIGHT]
    assert f"MiB  night={NIGHT}\n" in prune(out, "--nights", NEXT, "--yes")
    assert nights_in(out) == []


def test_it_asks_what(dataset):
    assert "--nights DATE" in prune(dataset, code=2)


@pytest.mark.long
def test_nights_in_a_store(s3, dataset):
    s3.put(str(dataset), "nights/prune", recursive=True)
    prune("s3://nights/prune", "--nights", NEXT, "--yes")
    s3.invalidate_cache()
    assert nights_in("s3://nights/prune") == [NEXT]
    assert not [path for path in s3.find("nights/prune") if NIGHT in path]

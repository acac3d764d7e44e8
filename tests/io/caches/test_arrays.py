"""Arrays kept on disk."""

import subprocess
import sys

import numpy as np
import pytest

from epipole.io.caches import arrays as array_cache
from epipole.io.caches.arrays import cache_folder, cached

ARRAYS = {"a": np.arange(1000.0), "b": np.array([[1, 2], [3, 4]], np.int32)}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Return the folder that EPIPOLE_CACHE names."""
    monkeypatch.setenv("EPIPOLE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


class Maker:
    """Makes ARRAYS, and counts how often."""

    calls = 0

    def __call__(self):
        self.calls += 1
        return ARRAYS


def test_what_was_made_is_read_and_not_made_again(folder):
    make = Maker()
    for _ in range(3):
        got = cached("key", make)
        assert set(got) == {"a", "b"}
        for name in ARRAYS:
            np.testing.assert_array_equal(got[name], ARRAYS[name])
            assert got[name].dtype == ARRAYS[name].dtype
            assert got[name].flags.writeable  # compiled kernels know writeable arrays
    assert make.calls == 1
    assert [p.name for p in folder.iterdir()] == ["key.npz"]


def test_another_key_is_made_anew(folder):
    make = Maker()
    cached("one", make)
    cached("two", make)
    assert make.calls == 2


@pytest.mark.parametrize("damage", ["cut", "empty", "text", "bit"])
def test_a_damaged_file_is_made_again_and_put_right(folder, damage):
    make = Maker()
    cached("key", make)
    path = folder / "key.npz"
    content = bytearray(path.read_bytes())
    if damage == "bit":
        content[len(content) // 3] ^= 1
    cases = {"cut": content[: len(content) // 2], "empty": b"", "text": b"none", "bit": content}
    path.write_bytes(cases[damage])
    np.testing.assert_array_equal(cached("key", make)["a"], ARRAYS["a"])
    assert make.calls == 2
    cached("key", make)
    assert make.calls == 2


@pytest.mark.parametrize("at", [6, 8])
def test_a_file_that_seems_of_another_version_or_encrypted_is_made_again(folder, at):
    make = Maker()
    cached("key", make)
    content = bytearray((folder / "key.npz").read_bytes())
    content[content.index(b"PK\x01\x02") + at] |= 0x41  # of the first entry in the directory
    (folder / "key.npz").write_bytes(content)
    np.testing.assert_array_equal(cached("key", make)["a"], ARRAYS["a"])
    assert make.calls == 2


def test_a_folder_that_cannot_be_written_to_stops_nothing(folder):
    folder.parent.mkdir(exist_ok=True)
    folder.touch()
    np.testing.assert_array_equal(cached("key", Maker())["a"], ARRAYS["a"])


def test_nothing_is_kept_where_the_user_wants_nothing(monkeypatch, tmp_path):
    monkeypatch.setenv("EPIPOLE_CACHE", "off")
    monkeypatch.chdir(tmp_path)
    make = Maker()
    cached("key", make)
    cached("key", make)
    assert make.calls == 2
    assert not list(tmp_path.iterdir())


def test_the_folder_is_the_users_cache_folder_unless_named(monkeypatch, tmp_path):
    monkeypatch.delenv("EPIPOLE_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder() == tmp_path / "epipole"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder() == tmp_path / ".cache" / "epipole"


def test_what_was_not_used_for_longest_goes_first(folder, monkeypatch):
    for key in ("old", "used", "new"):
        cached(key, Maker())
    size = (folder / "old.npz").stat().st_size
    cached("used", Maker())
    monkeypatch.setattr(array_cache, "LARGEST_BYTES", 3 * size + 10)
    cached("newest", Maker())
    assert sorted(p.stem for p in folder.glob("*.npz")) == ["new", "newest", "used"]


def test_processes_that_make_the_same_at_once_do_each_other_no_harm(folder):
    script = (
        "import numpy as np\n"
        "from epipole.io.caches.arrays import cached\n"
        "for k in range(40):\n"
        "    got = cached(f'key{k % 4}', lambda: {'a': np.arange(50_000) + k % 4})\n"
        "    assert got['a'].sum() == np.arange(50_000).sum() + 50_000 * (k % 4)\n"
        "    if k % 3 == 0:\n"
        "        import os, pathlib\n"
        "        pathlib.Path(os.environ['EPIPOLE_CACHE'], f'key{k % 4}.npz').unlink(True)\n"
    )
    processes = [subprocess.Popen([sys.executable, "-c", script]) for _ in range(3)]
    assert [p.wait(60) for p in processes] == [0, 0, 0]
    assert all(p.name.startswith("key") for p in folder.iterdir())

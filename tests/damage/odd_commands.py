"""Odd command lines and files: no traceback, no hang, an exit code that fits, one line of error.

`python tests/damage/odd_commands.py --commands 1000` prints those that fail, and counts by command.
All are called in one process. A run is not started: what is tried is all that comes before it.
"""

import argparse
import collections
import json
import os
import random
import signal
import sys
import tempfile
import traceback
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))  # for `damage`

from typer.testing import CliRunner

from damage.sound_logs import EXAMPLE
from epipole.flows.command_line.main import app
from epipole.flows.command_line.run_nightly import Nights
from epipole.schemas.errors import EpipoleError

LIMIT_S = 60  # of one command: the first that computes compiles for a while

NUMBERS = [
    "nan", "inf", "-inf", "-1", "0", "1e308", "1e-320", "9" * 30, "", " ", "0x10", "1,5",
    "\u0661", "½",
    "-0.0", "1_000", "1000000000",
]  # fmt: skip
DATES = [
    "0001-01-01", "1677-09-21", "2262-04-12", "9999-12-31", "2019-02-30", "2019-4-1", "20190401",
    "2019-W14-1", "yesterday", "",
    "\u0662\u0660\u0661\u0669-\u0660\u0664-\u0660\u0661", "2019-04-01T04:00:00Z",
    "2019-04-01\n", "../x",
]  # fmt: skip
TIMES = [f"{date}T23:59:59Z" for date in DATES[:4]] + [
    "2019-04-01T24:00:00Z", "2019-04-01T04:00:00+99:00", "2019-04-01T04:00:60Z", "0", "", "nan",
]  # fmt: skip
URLS = [
    "http://[::1", "http://", "http://[::1]:99999/a.mcap", "http://a b/c", "s3://", "s3:///x",
    "file://", "file:///none.mcap", "nothing://x", "://", "memory://none/x", "http://127.0.0.1:9/a",
    "x::http://127.0.0.1:9/a", "zip://a::b", "http://127.0.0.1:9/\x00", "simplecache::memory://a",
    "http://u:p@127.0.0.1:9/a?b=c", "data:,x", "git://x", "reference://",
]  # fmt: skip
TEXTS = [
    "", " ", "x" * 5000, "x" * 300, "a/" * 2500, "\udcff", "\x00", "a\nb", "🛰",
    "-", "--", "~", "/dev/null",
    "/dev/zero", "/proc/self/mem", "/", ".", "..", "*", "**/*", "[", "%s", "{}", "'", "C:\\x",
]  # fmt: skip
ELEMENTS = {
    "surrogate.json": b'[{"OBJECT_NAME": "\\ud800", "NORAD_CAT_ID": 5, "EPOCH": "2019-04-01T0"}]',
    "deep.json": b"[" * 100_000, "field.csv": b"MEAN_MOTION,OBJECT_NAME\n1," + b"x" * 140_000,
    "null.json": b"[null, 7, [], {}]", "digits.json": b'[{"NORAD_CAT_ID": ' + b"9" * 5000 + b"}]",
    "bomb.xml": b'<!DOCTYPE a [<!ENTITY b "' + b"x" * 1000 + b'">]><a>' + b"&b;" * 1000 + b"</a>",
    "nan.json": b'[{"NORAD_CAT_ID": NaN, "MEAN_MOTION": Infinity}]', "odd.xml": b"<\xff\xfe>",
    "lines.tle": b"1 \n2 \n" * 50, "short.tle": b"1 25544U",
    "utf16.csv": "MEAN_MOTION\n1".encode("utf-16"),
}  # fmt: skip
TOMLS = {
    "deep.toml": b"a = " + b"[" * 5000, "binary.toml": b"\xff\xfe\x00",
    "huge.toml": b"[work]\nmemory_mib = 1e400",
    "number.toml": b"[work]\nmemory_mib = " + b"9" * 5000, "twice.toml": b"a = 1\na = 2",
    "nan.toml": b"[identification]\nfalse_alarm = nan", "unknown.toml": b"[none]\nx = 1",
    "date.toml": b"start = 0001-01-01T00:00:00Z\nname = 'x'", "list.toml": b"sensors = 7",
    "name.toml": b"name = '\x1b[2J'\nsensors = []", "key.toml": b'"\\u0000" = 1',
}  # fmt: skip
LOGS = {
    "empty.mcap": b"", "magic.mcap": b"\x89MCAP0\r\n", "twice.mcap": b"\x89MCAP0\r\n" * 2,
    "text.mcap": b"time,x,y\n", "zeros.mcap": bytes(4096),
}  # fmt: skip


class Place(NamedTuple):
    """A folder with odd files in it, and the command lines' words."""

    folder: Path
    words: list[str]


def make_place(folder: Path) -> Place:
    """Write the odd files, and return the words of the command lines."""
    for name, content in {**ELEMENTS, **TOMLS, **LOGS}.items():
        (folder / name).write_bytes(content)
    (folder / "folder.mcap").mkdir()
    (folder / "link.mcap").symlink_to("link.mcap")
    os.mkfifo(folder / "pipe.mcap")
    (folder / "unreadable.mcap").write_bytes(b"x")
    (folder / "unreadable.mcap").chmod(0)
    for night in ("2019-04-01", "x", "9999-12-31"):
        (folder / "dataset" / f"night={night}" / "nights").mkdir(parents=True)
    (folder / "dataset" / "night=2019-04-01" / "nights" / "part-0.parquet").write_bytes(b"PAR1")
    (folder / "truth.truth").mkdir()
    (folder / "truth.truth" / "scenario.json").write_text(json.dumps([1]))
    files = [str(path) for path in folder.iterdir()]
    return Place(folder, [*files, *TEXTS, *URLS])


def command_lines(place: Place, count: int, seed: int) -> Iterator[list[str]]:
    """Yield odd command lines of all commands, in turn."""
    random_ = random.Random(seed)
    log, out = str(EXAMPLE), str(place.folder / "made" / "out")

    def word() -> str:
        return random_.choice(place.words)

    def either(sound: str) -> str:
        return random_.choice([sound, word()])

    def some(options: dict[str, Sequence[str]]) -> list[str]:
        chosen = random_.sample(sorted(options), random_.randint(0, min(3, len(options))))
        return [part for name in chosen for part in (name, random_.choice(options[name]))]

    words, dataset = place.words, str(place.folder / "dataset")
    makers: list[Any] = [
        lambda: ["run", either(log), "--out", either(out), *some({
            "--night": DATES, "--to": DATES, "--known": words, "--settings": words,
            "--workers": NUMBERS, "--runner": TEXTS, "--scheduler": URLS})],
        lambda: ["nights", either(dataset), *some({"--settings": words, "--known": words})],
        lambda: ["info", word(), *random_.choice([[], ["--json"]])],
        lambda: ["calibrate", word(), *some({"--settings": words, "--out": words})],
        lambda: ["simulate", either("four_sensor_geo"), "--out", either(f"{out}.mcap"), *some({
            "--seed": NUMBERS, "--sensors": NUMBERS, "--objects": NUMBERS, "--hours": NUMBERS,
            "--rate": NUMBERS, "--start": TIMES, "--logs": NUMBERS, "--encoding": TEXTS})],
        lambda: ["evaluate", either(dataset), "--truth", either(str(place.folder / "truth.truth"))],
        lambda: ["export", random_.choice(["tdm", "oem", "opm", word()]), either(dataset),
                 "--night", either("2019-04-01"), "--out", either(out)],
        lambda: ["overlay", either(dataset), either(log), "--out", either(out),
                 *some({"--night": DATES})],
        lambda: ["report", either(dataset), *some({"--night": DATES, "--out": words})],
        lambda: ["settings", *some({"--json": [""]})],
        lambda: ["deploy-files", "--out", either(str(place.folder / "deployed"))],
        lambda: ["catalog", "build", *random_.choice([[], [word()]]), "--out", either(out)],
    ]  # fmt: skip
    for number in range(count):
        yield makers[number % len(makers)]()


def fault_of(words: Sequence[str]) -> str | None:
    """Run a command, and return what is wrong with how it ended. None: nothing."""

    def late(*_: object) -> None:
        raise TimeoutError(f"hangs for {LIMIT_S} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(LIMIT_S)
    try:
        ended = CliRunner().invoke(app, list(words))
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)
    if ended.exception is not None and not isinstance(ended.exception, SystemExit):
        return "".join(traceback.format_exception(ended.exception)[-3:])
    if ended.exit_code not in (0, 1, 2):
        return f"exit code {ended.exit_code}"
    lines = ended.stderr.splitlines()
    if ended.exit_code == 1 and sum(line.startswith("epipole: ") for line in lines) != 1:
        return f"exit code 1 and not one line: {ended.stderr[-300:]!r}"
    if "Traceback" in ended.stderr:
        return ended.stderr[-500:]
    return None


def faults(count: int, seed: int, folder: Path) -> Iterator[tuple[list[str], str | None]]:
    """Yield odd command lines, and what is wrong with how each ended."""
    place = make_place(folder)

    def start(self: Nights, _started: object) -> Any:
        raise EpipoleError("all is sound; the run would start")

    real, here = Nights._start, Path.cwd()
    (folder / "here").mkdir()
    os.chdir(folder / "here")  # some words name files that would be written
    Nights._start = start  # type: ignore[method-assign]
    try:
        for words in command_lines(place, count, seed):
            yield words, fault_of(words)
    finally:
        Nights._start = real  # type: ignore[method-assign]
        os.chdir(here)


def main() -> int:
    """Try odd command lines, and print those that fail."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--commands", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    tried: collections.Counter[str] = collections.Counter()
    failed: collections.Counter[str] = collections.Counter()
    with tempfile.TemporaryDirectory() as folder:
        for words, fault in faults(asked.commands, asked.seed, Path(folder)):
            tried[words[0]] += 1
            if fault is not None:
                failed[words[0]] += 1
                print([word[:60] for word in words], fault, sep="\n", flush=True)
    for command, count in tried.items():
        print(f"{command:14}{count:6}{failed[command]:6} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

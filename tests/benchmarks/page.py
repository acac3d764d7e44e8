"""The tables of BENCHMARKS.md, and the README's: each benchmark is run, its output put in its part.

    .ci/generate benchmarks [NAME ...] [--list]

A part stands between two marks, as in the other pages (`docs/generated.py`). What is run takes an
hour on two cores, one benchmark after the other. Results are kept in build/benchmarks: a round that
was stopped goes on where it stopped, as long as the commit is the same. With names, only these are
run. A part without a result stays as it is.
"""

import argparse
import contextlib
import datetime
import json
import os
import platform
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "BENCHMARKS.md"
README = ROOT / "README.md"
RESULTS = ROOT / "build" / "benchmarks"
MACHINE = "machine"  # the part that says when, where and with what all was measured

sys.path.append(str(ROOT / "docs"))
from generated import part, with_part  # noqa: E402


class Benchmark(NamedTuple):
    """One part of the page: a script of this folder, its arguments, and its longest time.

    In the arguments, {folder} is an empty folder. Of a long output, only the `lines` in which this
    pattern is found are on the page, and of its tables these `columns`; empty: all.
    """

    script: str
    arguments: str = ""
    max_minutes: float = 5.0
    lines: str = ""
    columns: tuple[str, ...] = ()

    @property
    def command(self) -> str:
        """The command as the page shows it."""
        return f"python tests/benchmarks/bench_{self.script}.py {self.arguments}".rstrip().format(
            folder="FOLDER"
        )


class Result(NamedTuple):
    """What a benchmark printed, and when and from which commit and machine."""

    output: str
    seconds: float
    date: str
    commit: str
    machine: str


GREAT_BEAR = "tests/photographs/great_bear.csv --width 5184 --height 3456 --field 25.9 --year 2011"
OF_README = "scenes"  # the part that stands there
# By the name of the part, in the order of the page.
PLAN = {
    OF_README: Benchmark("scenes", "", 12),
    "example": Benchmark("example", "--rounds 3", 10),
    "night": Benchmark("night", "--shares 16 1", 10),
    "scaling": Benchmark("scaling", "--sensors 128", 8),
    "constellation": Benchmark("scaling", "--satellites 24 96 384 --seconds 20", 8),
    "ingest": Benchmark("ingest", "--frames 100000 --runs 5"),
    "ingest_json": Benchmark("ingest", "--frames 20000 --runs 5 --encoding json"),
    "queries": Benchmark(
        "queries",
        "--nights 365 --runs 5",
        8,
        columns=("query", "rows", "wall s", "CPU s", "goal s"),
    ),
    "simulation": Benchmark("simulation", "--hours 1"),
    "page": Benchmark("page", "--rounds 5"),
    "star_identification": Benchmark(
        "star_identification", "--made 1800 --seed 82 --no-peers", 20, "epipole|published|Camera"
    ),
    "crowded_frames": Benchmark(
        "crowded_frames",
        "--frames 36 --seed 94",
        10,
        "(500|970) .* 0 .*(True|False)",
        ("camera", "false", "flux", "right %", "wrong"),
    ),
    "unlike_frames": Benchmark(
        "unlike_frames",
        "--cameras b --frames 60 --seed 602",
        8,
        "(like|errors|shaken).*none",
        ("kind", "error px", "identified %", "wrong", "across", "about"),
    ),
    "unknown_cameras": Benchmark("unknown_cameras", "--frames 20 --told 0.95", 10, "field|yes"),
    "false_alarms": Benchmark(
        "false_alarms",
        "searched --seconds 240 --seed 403",
        8,
        "searched|all|clusters|hot|lines|uniform",
        ("kind", "frames", "attitudes", "that over the setting"),
    ),
    "untold_optics": Benchmark(
        "untold_optics",
        "--sensors 6 --frames 40 --fields 8 20 --place drawn --seed 23",
        10,
        "k1 1|f 3|principal|none",
        ("field deg", "untold", "optics", "sensors", "across", "about"),
    ),
    "photographs": Benchmark(
        "photographs", f"{GREAT_BEAR} --reach 6.5 --step 0.5", lines="focal|^ +[+]"
    ),
    "catalogue": Benchmark("catalogue", "build --repeats 3", lines="degrees"),
    "tracking": Benchmark("tracking", "--false 10 100 1000 --repeats 1", 8),
    "tracking_few": Benchmark("tracking", "--few --seeds 200"),
    "track_linking": Benchmark("track_linking", "--seeds 4 --first 300", 8, "gap|250 +(30|120)"),
    "association": Benchmark("association", "points --seeds 10 --false 100 300 1000", 10),
    "many_sensors": Benchmark("association", "scale --seeds 2", 5),
    "tracklets": Benchmark("association", "tracklets --seeds 5", 8),
    "positions": Benchmark("positions", "--positions 3000"),
    "alignment": Benchmark("alignment", "--seeds 3", 6, "exposures|together|apart, 1"),
    "clocks": Benchmark("clocks", "--offsets 0 0.02 0.05 0.2 0.5 1", 6),
    "identity": Benchmark("identity", "--gaps 120 900 1800 --seeds 1 2", 6),
    "epipolar": Benchmark(
        "epipolar",
        "--scenes 100",
        8,
        "Threshold|with L|^ +(8|12) +[0-9]|Ambiguous|random|published: 10",
    ),
    "orbit_fits": Benchmark("orbit_fits", "--seeds 4", 8),
    "orbit_linking": Benchmark("orbit_linking", "--satellites 60 240 420 --hours 1", 5),
    "orekit_orbits": Benchmark("orekit_orbits", lines="log|all"),
    "known_objects": Benchmark("known_objects", "--objects 300 --ages 3 10", 8, "ages|listed:"),
    "real_orbits": Benchmark(
        "real_orbits",
        "--scenes 4 --seed 71 --out {folder}",
        12,
        '^ +(scene|geo|low)|lost|recall|nees_mean"',
    ),
    "passages": Benchmark("passages", "--seeds 1 2 3", 6),
}


def commit() -> str:
    """Return the commit of the working tree, and whether its files differ from it.

    A copy without a repository has none.
    """
    git = ("git", "-C", str(ROOT))
    name = subprocess.run(
        [*git, "rev-parse", "--short", "HEAD"], check=False, capture_output=True, text=True
    )
    if name.returncode:
        return "no commit"
    written = [f":!{page.name}" for page in (PAGE, README)]  # by a round before
    changed = subprocess.run([*git, "diff", "--quiet", "HEAD", "--", ".", *written])
    return name.stdout.strip() + (" with changes" if changed.returncode else "")


def machine() -> str:
    """Return what the figures depend on: cores, memory, system, Python."""
    gib = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    python = f"Python {platform.python_version()}"
    return f"{os.cpu_count()} cores, {gib:.0f} GiB, {platform.system()}, {python}"


def run(benchmark: Benchmark) -> Result:
    """Run a benchmark in a process of its own.

    Raises
    ------
    RuntimeError
        If it fails or takes too long; the message is the end of what it said.
    """
    script = Path(__file__).with_name(f"bench_{benchmark.script}.py")
    today, here = datetime.datetime.now(datetime.UTC).date().isoformat(), commit()
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryFile("w+") as errors:
        arguments = benchmark.arguments.format(folder=f"{folder}/out").split()
        process = subprocess.Popen(
            [sys.executable, str(script), *arguments],
            cwd=ROOT, env=os.environ | {"PREFECT_HOME": f"{folder}/prefect"}, text=True,
            stdout=subprocess.PIPE, stderr=errors, start_new_session=True,
        )  # fmt: skip
        start = time.monotonic()
        try:
            output, _ = process.communicate(timeout=60 * benchmark.max_minutes)
        except BaseException as stopped:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            if isinstance(stopped, subprocess.TimeoutExpired):
                raise RuntimeError(f"not done after {benchmark.max_minutes:g} minutes") from None
            raise
        if process.returncode:
            errors.seek(0)
            raise RuntimeError(errors.read().strip()[-800:])
    return Result(output, time.monotonic() - start, today, here, machine())


def shown(output: str, benchmark: Benchmark) -> str:
    """Return what the page shows of an output: the lines and columns of the benchmark."""
    kept: list[str] = []
    cells: list[int] = []
    before = ""
    for line in output.splitlines():
        is_row = line.startswith("|")
        is_head = is_row and not before.startswith("|")
        before = line
        if is_head:
            names = [name.strip() for name in line.split("|")[1:-1]]
            cells = [names.index(name) for name in benchmark.columns] or list(range(len(names)))
        elif not (re.fullmatch(r"[|\-: ]+", line) or re.search(benchmark.lines, line)):
            continue
        if is_row:
            row = line.split("|")[1:-1]
            line = f"|{'|'.join(row[k] for k in cells)}|"
        kept.append(line)
    return "\n".join(kept)


def as_markdown(output: str) -> str:
    """Return what a benchmark printed: its tables as they are, all else between fences."""
    blocks: list[tuple[bool, list[str]]] = []
    for line in filter(str.strip, output.splitlines()):
        is_row = line.startswith("|")
        if not blocks or blocks[-1][0] != is_row:
            blocks.append((is_row, []))
        blocks[-1][1].append(line.rstrip())
    texts = []
    for is_table, lines in blocks:
        if not is_table:
            lines = ["```text", *lines, "```"]
        elif len(lines) > 1 and not re.fullmatch(r"[|\-: ]+", lines[1]):
            lines.insert(1, "|" + "---|" * (lines[0].count("|") - 1))
        texts.append("\n".join(lines) + "\n")
    return "\n".join(texts)


def part_of(
    benchmark: Benchmark, result: Result, *, alone: bool, on_one_machine: bool = False
) -> str:
    """Return the text of a part; with `alone` also its date, commit and machine.

    With `on_one_machine` the page says the machine of all parts.
    """
    where = "" if on_one_machine else f"; {result.machine}"
    of_its_own = f" {result.date}, commit {result.commit}{where}." if alone else ""
    head = f"`{benchmark.command}` ({result.seconds:.0f} s).{of_its_own}"
    return f"{head}\n\n{as_markdown(shown(result.output, benchmark))}"


def kept_results() -> dict[str, Result]:
    """Return the results in build/benchmarks by the name of their part."""
    files = ((name, RESULTS / f"{name}.json") for name in PLAN)
    return {name: Result(**json.loads(f.read_text())) for name, f in files if f.exists()}


def write_page(results: dict[str, Result]) -> None:
    """Put all results in their parts."""
    text = PAGE.read_text()
    origins = {(result.date, result.commit, result.machine) for result in results.values()}
    machines = {result.machine for result in results.values()}
    on_one_machine = len(machines) == 1
    whole = len({origin[1:] for origin in origins}) == 1 and set(results) == set(PLAN)
    if whole:
        date, which, where = max(origins)
        minutes = sum(result.seconds for result in results.values()) / 60
        said = f"All tables: {date}, commit {which}; {where}; {minutes:.0f} minutes.\n"
    else:
        said = "Not all tables are of one commit yet: each says its date and commit.\n"
        if on_one_machine:
            said = f"{said.strip()} {', '.join(machines)}.\n"
    text = with_part(text, MACHINE, said)
    for name, result in results.items():
        if name == OF_README:
            content = part_of(PLAN[name], result, alone=True)
            README.write_text(with_part(README.read_text(), name, content))
        else:
            content = part_of(PLAN[name], result, alone=not whole, on_one_machine=on_one_machine)
            text = with_part(text, name, content)
    PAGE.write_text(text)


def main() -> int:
    """Run what was asked for and write the page; return 1 if a benchmark failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="parts; without: all")
    parser.add_argument("--list", action="store_true", help="print names and commands only")
    chosen = parser.parse_args()
    if unknown := set(chosen.names) - set(PLAN):
        parser.error(f"no such part: {', '.join(sorted(unknown))}")
    if chosen.list:
        print("\n".join(f"{name:20} {b.command}" for name, b in PLAN.items()))
        return 0
    for name in PLAN:
        # A missing part is an error before the hour, not after it.
        part((README if name == OF_README else PAGE).read_text(), name)
    RESULTS.mkdir(parents=True, exist_ok=True)
    failed, here, kept = [], commit(), kept_results()
    for name in chosen.names or PLAN:
        if not chosen.names and name in kept and kept[name].commit == here:
            continue
        print(f"{name}: {PLAN[name].command}", flush=True)
        try:
            result = run(PLAN[name])
        except RuntimeError as error:
            failed.append(name)
            print(f"  failed: {error}", flush=True)
            continue
        (RESULTS / f"{name}.json").write_text(json.dumps(result._asdict(), indent=1) + "\n")
        print(f"  {result.seconds:.0f} s", flush=True)
    write_page(kept_results())
    if failed:
        print(f"failed, and left as they stand in the page: {', '.join(failed)}")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())

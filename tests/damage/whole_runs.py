"""Whole runs of damaged logs, and of a sound one with settings at their bounds.

`python tests/damage/whole_runs.py --runs 100 --settings` prints a table of results.
"""

import argparse
import collections
import sys
import tempfile
import time
import traceback
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).parents[1]))  # for `damage` and `scenes`

import polars as pl

from damage import cases, odd_settings
from damage.judge import forget_peak, peak_bytes
from damage.sound_logs import EXAMPLE
from epipole.flows.nightly import nightly
from epipole.flows.prefect.defaults import embedded_prefect, quiet_console
from epipole.io.logs.reader import read_log
from epipole.schemas.errors import EpipoleError
from epipole.schemas.given_settings import validate_settings
from epipole.schemas.settings import Settings

TWICE = ("duplicate_frame", "duplicate_number", "duplicate_time")
MAX_CPU_S = 120.0


class Run(NamedTuple):
    """What came of a run: published or refused, or what is wrong."""

    outcome: str
    fault: bool
    cpu_s: float = 0.0
    peak_bytes: int = 0  # of the whole process


def run(log: Path, out: Path, settings: Settings) -> Run:
    """Return what comes of a whole run."""
    forget_peak()
    began = time.process_time()
    outcome, fault = _outcome(log, out, settings)
    cpu_s, peak = time.process_time() - began, peak_bytes()
    if cpu_s > MAX_CPU_S:
        outcome, fault = f"took {cpu_s:.0f} s of CPU", True
    return Run(outcome, fault, cpu_s, peak)


def _outcome(log: Path, out: Path, settings: Settings) -> tuple[str, bool]:
    try:
        nightly(str(log), str(out), settings)
        wrong = _wrong_frames(log, out)
    except EpipoleError as error:
        return "refused", "\n" in str(error)
    except Exception:
        # Whatever is not an error of the product's own is what this looks for.
        wrong = traceback.format_exc()
    return wrong or "published", wrong is not None


def _wrong_frames(log: Path, out: Path) -> str | None:
    """Return how many frames were read and are neither published nor counted."""
    read = len(read_log(log).exposures)
    published = pl.read_parquet(out / "night=*" / "frames" / "*.parquet").height
    rejects = pl.read_parquet(out / "night=*" / "rejects" / "*.parquet")
    counts = {row["reason"]: row["count"] for row in _by_reason(rejects)}
    twice = sum(counts.get(reason, 0) for reason in TWICE)
    # Of a sensor that has a calibration later, such frames are published, with a status.
    uncalibrated = counts.get("no_calibration", 0)
    if not published + twice <= read <= published + twice + uncalibrated:
        return f"{read} frames read, {published} published, left out: {counts}"
    return None


def _by_reason(rejects: pl.DataFrame) -> list[dict[str, Any]]:
    return rejects.group_by("reason").agg(pl.col("count").sum()).to_dicts()


def run_of_case(number: int, folder: Path) -> Run:
    """Return what comes of the damaged log of a number."""
    log = folder / "damaged.mcap"
    log.write_bytes(cases.case(number).log)
    return run(log, folder / "out", Settings())


def run_of_setting(group: str, name: str, value: Any, folder: Path) -> Run:
    """Return what comes of the example with one setting."""
    try:
        settings = validate_settings({group: {name: value}}, "here")
    except EpipoleError:
        return Run("refused", False)
    return run(EXAMPLE, folder / "out", settings)


def main() -> int:
    """Run all that is asked, print what is wrong as it comes, then the table; 1 if anything is."""
    options = _options()
    asked: list[tuple[str, Any, tuple[Any, ...]]] = [
        ("damaged logs", run_of_case, (number,))
        for number in range(options.first, options.first + options.runs)
    ]
    if options.settings:
        asked += [("settings", run_of_setting, extreme) for extreme in odd_settings.extremes()]
    found = collections.Counter[tuple[str, str]]()
    most_cpu_s, max_bytes = (0.0, ""), (0, "")
    quiet_console()
    with embedded_prefect():
        for what, do, arguments in asked:
            with tempfile.TemporaryDirectory() as folder:
                came = do(*arguments, Path(folder))
            most_cpu_s = max(most_cpu_s, (came.cpu_s, f"{what} {arguments}"))
            max_bytes = max(max_bytes, (came.peak_bytes, f"{what} {arguments}"))
            found[what, "FAULT" if came.fault else came.outcome] += 1
            if came.fault:
                print(f"{what} {arguments}: {came.outcome}", flush=True)
    for key, n in sorted(found.items()):
        print(f"| {' | '.join(key)} | {n:,} |")
    print(f"most CPU for one run {most_cpu_s[0]:.1f} s ({most_cpu_s[1]})")
    print(f"most memory {max_bytes[0] >> 20} MiB ({max_bytes[1]})")
    return int(any(outcome == "FAULT" for _, outcome in found))


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=100, help="how many damaged logs")
    parser.add_argument("--first", type=int, default=0, help="the first number")
    parser.add_argument("--settings", action="store_true", help="settings at their bounds too")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())

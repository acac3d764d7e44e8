"""Reads a damaged log as the product does, and says what is wrong with what came out."""

import collections
import contextlib
import functools
import math
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from damage.cases import Case, Promise
from damage.sound_logs import count, keys_of, sound_log
from epipole.io.logs.logged_times import read_log_times
from epipole.io.logs.reader import read_log, read_log_pieces
from epipole.schemas.bridge import array, flatten
from epipole.schemas.errors import LogError
from epipole.schemas.rejects import Reason
from epipole.schemas.work_tables import LogContents

MAX_CPU_S = 5.0  # at the speed of `REFERENCE_S`; the slowest case takes 2
REFERENCE_S = 0.10  # for a million steps of a loop, on a processor of 3 GHz
MAX_BYTES = 1 << 30  # that a log adds to what the process has
PIECE_BYTES = 20_000  # so that a small log has several pieces

# Rows of `rejects` that are about no lost message: the frame or state is used, or it is about the
# file as a whole.
KEPT = {
    Reason.BAD_EXPOSURE, Reason.BAD_ATTITUDE, Reason.VAGUE_ATTITUDE, Reason.RESTARTED_COUNTER,
}  # fmt: skip
OF_FILE = {Reason.TRUNCATED, Reason.LOG_BEHIND_LOG, Reason.BAD_DATA_CHECKSUM}


class Verdict(NamedTuple):
    """What came of a damaged log."""

    outcome: str  # all read, some left out, refused; or what is wrong
    fault: bool
    reasons: dict[str, int]
    cpu_s: float
    peak_bytes: int


@functools.cache
def slowness() -> float:
    """Return how many times slower this machine is than that of `REFERENCE_S`, at least 1."""
    taken = []
    for _ in range(5):
        began, total = time.process_time(), 0
        for k in range(1_000_000):
            total += k * k
        taken.append(time.process_time() - began)
    return max(min(taken) / REFERENCE_S, 1.0)


def judge(case: Case, folder: Path) -> Verdict:
    """Return what comes of reading a damaged log. Other errors than the product's own rise."""
    path = folder / "damaged.mcap"
    path.write_bytes(case.log)
    before = forget_peak()
    outcome, fault, reasons, cpu_s = _outcome(case, path)
    peak = peak_bytes()
    if cpu_s > MAX_CPU_S * slowness():
        outcome, fault = f"took {cpu_s:.1f} s of CPU", True
    elif peak - before > MAX_BYTES:
        outcome, fault = f"took {(peak - before) >> 20} MiB", True
    return Verdict(outcome, fault, reasons, cpu_s, peak)


def warm_up() -> None:
    """Read sound logs, so that all loops are compiled."""
    with tempfile.TemporaryDirectory() as folder:
        for name in ("protobuf_zstd", "json_zstd", "ros2_lz4", "example"):
            sound = Case(name, sound_log(name), count(name), Promise.EXACT)
            if (found := judge(sound, Path(folder))).fault:
                raise AssertionError(f"{name}: {found.outcome}")


def _outcome(case: Case, path: Path) -> tuple[str, bool, dict[str, int], float]:
    began = time.process_time()
    try:
        log = read_log(path)
    except LogError as error:
        line, one_line = str(error), "\n" not in str(error)
        cpu_s = time.process_time() - began
        return ("refused" if one_line else f"not one line: {line}"), not one_line, {}, cpu_s
    cpu_s = time.process_time() - began
    reasons = _reasons(log)
    wrong = _wrong_count(case, log, reasons) or _wrong_value(log) or _wrong_pieces(path, log)
    outcome = wrong or ("all read" if n_read(log) >= case.n else "some left out")
    return outcome, wrong is not None, reasons, cpu_s


def n_read(log: LogContents) -> int:
    """Return how many messages were read."""
    return len(log.exposures) + len(log.states) + len(log.cameras)


def _reasons(log: LogContents) -> dict[str, int]:
    found: collections.Counter[str] = collections.Counter()
    columns = (log.rejects[name].to_pylist() for name in ("reason", "count"))
    for reason, n in zip(*columns, strict=True):
        found[reason] += n
    return dict(found)


def _wrong_count(case: Case, log: LogContents, reasons: dict[str, int]) -> str | None:
    """Return which messages are neither read nor counted."""
    read = n_read(log)
    lost = sum(count for reason, count in reasons.items() if Reason(reason) not in KEPT | OF_FILE)
    if min(reasons.values(), default=1) < 1:
        return f"a count below 1: {reasons}"
    if case.promise == Promise.EXACT and read + lost != case.n:
        return f"{case.n} messages, {read} read, {lost} counted: {reasons}"
    if case.promise == Promise.COUNTED and read + lost < case.n:
        return f"{case.n} messages, only {read} read and {lost} counted: {reasons}"
    if case.promise == Promise.SAID and not reasons:
        silent = max(case.n - read, len(case.keys - keys_of(log)))
        return f"{silent} of {case.n} messages lost, and nothing said" if silent > 0 else None
    return None


def _wrong_value(log: LogContents) -> str | None:
    """Return which column has a value that no kernel may meet."""
    frames, states = log.exposures, log.states
    columns = {f"{name}_px": _flat(frames, f"{name}_px", 1e6) for name in "xy"}
    columns |= {f"{a}_km": _within(array(states, f"{a}_km"), 1.001e7) for a in "xyz"}
    columns["exposure_s"] = _within(array(frames, "exposure_s"), 3600.0)
    for name in ("fx_px", "cx_px", "cy_px", "k1", "k2", "p1", "p2", "k3"):
        columns[name] = _within(array(log.cameras, name), 1e9)
    wrong = [name for name, good in columns.items() if not good]
    return f"impossible values in {', '.join(wrong)}" if wrong else None


def _flat(frames: object, name: str, most: float) -> bool:
    values, _ = flatten(frames, name)
    return _within(values, most)


def _within(values: npt.NDArray[np.floating], most: float) -> bool:
    return bool((np.abs(values) <= most).all())  # false for NaN


def _wrong_pieces(path: Path, log: LogContents) -> str | None:
    """Return whether the log in pieces differs from the log as a whole, strays aside."""
    n = sum(len(p.exposures) + len(p.states) + len(p.cameras)
            for p in read_log_pieces(path, PIECE_BYTES))  # fmt: skip
    strays = _reasons(log).get(Reason.STRAY_TIME, 0)
    times = read_log_times(path)
    if times is not None and not all(math.isfinite(t) for t in times):
        return f"logged at {times}"
    return None if n == n_read(log) + strays else f"{n} in pieces, {n_read(log)} as a whole"


def forget_peak() -> int:
    """Measure the peak of memory from now on; return what the process has now."""
    with contextlib.suppress(OSError):  # some containers forbid it: then the peak is that of before
        Path("/proc/self/clear_refs").write_text("5")
    return peak_bytes()


def peak_bytes() -> int:
    """Return the most memory that this process had since `forget_peak`."""
    status = Path("/proc/self/status").read_text()
    line = next(line for line in status.splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) << 10

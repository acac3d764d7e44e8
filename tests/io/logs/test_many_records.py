"""What a log of very many records costs: bounded memory, and time in proportion."""

import subprocess
import sys
from pathlib import Path

import pytest
from scenes import many_records

KINDS = [*many_records.KINDS, "chunk indexes"]
SLOW = {"chunks", "chunks with a wrong checksum", "messages and chunks in turn"}
# Left out one by one, each counted in `rejects`.
COUNTED = {
    "foreign records",
    "empty data ends",
    "empty messages",
    "messages without a channel",
    "chunks with a wrong checksum",
}
QUICK = [*sorted(COUNTED), "messages and chunks in turn", "channels", "chunk indexes"]
SLOWEST = "logs in sequence"
MAX_RATIO = 8.0  # of the CPU time for four times as many; in proportion it is four
NO_TIME_S = 0.2  # CPU times below it are noise
ROWS_MIB = 50.0  # that the rows of `rejects` take, which are bounded by their number
INDEX_BYTES = 150  # in memory for an index of a chunk: the summary is read as a whole

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="asks Linux for the memory")


def measured(*asked):
    """Return for each kind and number: CPU time [s], memory [MiB], rows and count of rejects."""
    command = [sys.executable, many_records.__file__, *(f"{kind}:{n}" for kind, n in asked)]
    out = subprocess.run(
        command, capture_output=True, text=True, check=True, cwd=Path(__file__).parents[2]
    ).stdout
    return [tuple(map(float, line.split())) for line in out.splitlines()]


def check(kind, n, memory_mib):
    (few_s, _, _, _), (cpu_s, mib, rows, count) = measured((kind, n // 4), (kind, n))
    assert cpu_s < MAX_RATIO * max(few_s, NO_TIME_S)
    assert mib < memory_mib
    assert rows < 60_000
    assert count == n or kind not in COUNTED


@pytest.mark.parametrize("kind", QUICK)
def test_many_records_take_little_memory_and_time_in_proportion(kind):
    n = 16_000 if kind in SLOW else 400_000
    check(kind, n, ROWS_MIB + n * INDEX_BYTES / (1 << 20) * (kind == "chunk indexes"))


@pytest.mark.long
@pytest.mark.parametrize("kind", KINDS)
def test_millions_of_records_stay_below_a_gibibyte(kind):
    # Of slow ones fewer, in less memory: 1.4 kB each would be too much.
    n, mib = (80_000, 100) if kind in SLOW else (2_000_000, 100)
    if kind == "chunk indexes":  # of which all are in memory
        n, mib = 5_000_000, 700
    check(kind, 40_000 if kind == SLOWEST else n, mib)

"""Nights whose storage fails at a random write or read, and what must hold after each failure.

    python tests/scenes/failing_storage.py [--faults 100] [--seed 1]

A small C library (it needs a compiler, `cc`) stands between the program and the system. It lets a
call fail that opens, writes, syncs or moves a file of the dataset, or that reads a log. After each
fault this is checked:

- the run ended well, or with an error of one line that `epipole` has a name for;
- the nights in the dataset are whole and of one run;
- the run started again, without a fault, gives the same bytes as a run that never met one.
"""

import argparse
import contextlib
import ctypes
import errno
import logging
import os
import random
import shutil
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from pathlib import Path
from typing import NamedTuple

sys.path.append(str(Path(__file__).parents[1]))

from epipole.schemas.given_settings import validate_settings
from scenes.dataset_tables import contents
from scenes.killed_runs import Contents, check_dataset, make_logs

FAULTY = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <sys/uio.h>
#include <unistd.h>

static char under[4096];
static int left, code, forever, reading, armed;
static int calls;

void arm(const char *folder, int at, int error, int stays, int reads) {
    strncpy(under, folder, sizeof under - 1);
    left = at; code = error; forever = stays; reading = reads; calls = 0; armed = 1;
}
void disarm(void) { armed = 0; }
int seen(void) { return calls; }

static int fails(const char *path, int reads) {
    if (!armed || reads != reading || !path || strncmp(path, under, strlen(under))) return 0;
    int number = __sync_add_and_fetch(&calls, 1);
    if (left > 0 && (number == left || (forever && number > left))) { errno = code; return 1; }
    return 0;
}
static int handle_fails(int fd, int reads) {
    char name[64], path[4096];
    if (!armed || reads != reading) return 0;
    snprintf(name, sizeof name, "/proc/self/fd/%d", fd);
    ssize_t n = readlink(name, path, sizeof path - 1);
    if (n < 0) return 0;
    path[n] = 0;
    return fails(path, reads);
}
#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define MODE va_list a; va_start(a, flags); int mode = va_arg(a, int); va_end(a)
#define OPEN(name) int name(const char *path, int flags, ...) { MODE; \
    if ((flags & O_CREAT) && fails(path, 0)) return -1; return REAL(name)(path, flags, mode); }
OPEN(open)
OPEN(open64)
#define OPENAT(name) int name(int at, const char *path, int flags, ...) { MODE; \
    if ((flags & O_CREAT) && fails(path, 0)) return -1; return REAL(name)(at, path, flags, mode); }
OPENAT(openat)
OPENAT(openat64)
ssize_t write(int fd, const void *b, size_t n)
{ return handle_fails(fd, 0) ? -1 : REAL(write)(fd, b, n); }
ssize_t pwrite64(int fd, const void *b, size_t n, off64_t o)
{ return handle_fails(fd, 0) ? -1 : REAL(pwrite64)(fd, b, n, o); }
ssize_t writev(int fd, const struct iovec *v, int n)
{ return handle_fails(fd, 0) ? -1 : REAL(writev)(fd, v, n); }
ssize_t read(int fd, void *b, size_t n)
{ return handle_fails(fd, 1) ? -1 : REAL(read)(fd, b, n); }
ssize_t pread(int fd, void *b, size_t n, off_t o)
{ return handle_fails(fd, 1) ? -1 : REAL(pread)(fd, b, n, o); }
ssize_t pread64(int fd, void *b, size_t n, off64_t o)
{ return handle_fails(fd, 1) ? -1 : REAL(pread64)(fd, b, n, o); }
int fsync(int fd) { return handle_fails(fd, 0) ? -1 : REAL(fsync)(fd); }
int mkdir(const char *p, mode_t m) { return fails(p, 0) ? -1 : REAL(mkdir)(p, m); }
int rename(const char *p, const char *q) { return fails(q, 0) ? -1 : REAL(rename)(p, q); }
int renameat2(int a, const char *p, int b, const char *q, unsigned f)
{ return fails(q, 0) ? -1 : REAL(renameat2)(a, p, b, q, f); }
"""


class Fault(NamedTuple):
    """What fails."""

    name: str
    code: int
    stays: bool  # all later calls fail too
    reads: bool = False


FAULTS = [
    Fault("disk full", errno.ENOSPC, True),
    Fault("quota exceeded", errno.EDQUOT, True),
    Fault("read-only", errno.EROFS, True),
    Fault("one write fails", errno.EIO, False),
    Fault("all writes fail", errno.EIO, True),
    Fault("one read fails", errno.EIO, False, True),
    Fault("all reads fail", errno.EIO, True, True),
]
# Without a report, half of a run's time: the records of runs are written beside the nights too.
PLAIN = validate_settings({"report": {"write": False}}, "here")
VANISH = Fault("the folder is removed", 0, True)
VANISHES_WITHIN_S = 4.0  # about as long as a run


def library(folder: Path) -> Path:
    """Return the compiled library."""
    made = folder / "faulty.so"
    command = ["cc", "-shared", "-fPIC", "-O1", "-x", "c", "-", "-o", str(made), "-ldl"]
    subprocess.run(command, input=FAULTY, text=True, check=True)
    return made


class FailingRuns:
    """Runs of two logs in one process, on storage that fails when asked to."""

    def __init__(self, folder: Path) -> None:
        self.storage = ctypes.CDLL(os.environ["LD_PRELOAD"])
        self.out, self.logs = folder / "out", make_logs(folder)
        self.whole: list[Contents] = []
        for log in range(len(self.logs)):
            assert self.run(log) is None
            self.whole.append(contents(self.out))

    def run(self, log: int) -> Exception | None:
        """Run a log, and return its error."""
        from epipole.flows.nightly import nightly

        try:
            nightly([str(self.logs[log])], str(self.out), PLAIN, replace=True, again=True)
        except Exception as error:
            return error
        return None

    def calls(self, log: int, reads: bool) -> int:
        """Return how many calls of a run can fail."""
        self.storage.arm(str(self._where(log, reads)).encode(), 0, 0, 0, reads)
        self.run(log)
        self.storage.disarm()
        return int(self.storage.seen())

    def fail(self, log: int, fault: Fault, at: int) -> str:
        """Run a log on storage that fails at a call; check all, and return how it ended."""
        before = check_dataset(self.out, self.whole)
        where = str(self._where(log, fault.reads)).encode()
        self.storage.arm(where, at, fault.code, fault.stays, fault.reads)
        error = self.run(log)
        self.storage.disarm()
        after = check_dataset(self.out, self.whole)
        if error is None:
            assert after == log, "it says that it has published, and has not"
        elif "the dataset is unchanged" in str(error):
            assert after == before, f"it says that nothing has changed: {error}"
        return self._finish(log, error)

    def vanish(self, log: int, after_s: float) -> str:
        """Run a log, and remove the dataset's folder meanwhile."""
        remove = threading.Timer(after_s, shutil.rmtree, [self.out], {"ignore_errors": True})
        remove.start()
        error = self.run(log)
        remove.join()
        check_dataset(self.out, self.whole)
        return self._finish(log, error)

    def _finish(self, log: int, error: Exception | None) -> str:
        """Check the error of a run, run again, and return how the first run ended."""
        from epipole.schemas.errors import EpipoleError

        assert error is None or isinstance(error, EpipoleError), repr(error)
        assert error is None or len(str(error).splitlines()) == 1, str(error)
        again = self.run(log)
        assert again is None, again
        assert contents(self.out) == self.whole[log], "other bytes than of a run without a fault"
        return "no harm" if error is None else f"one line: {error}"

    def _where(self, log: int, reads: bool) -> Path:
        return self.logs[log] if reads else self.out


def fail_at_random(folder: Path, faults: int, seed: int) -> Counter[tuple[str, str]]:
    """Return how runs with random faults ended."""
    from epipole.flows.prefect.defaults import embedded_prefect, quiet_console

    quiet_console()
    rng, counts = random.Random(seed), Counter[tuple[str, str]]()
    with embedded_prefect():
        runs = FailingRuns(folder)
        faulty = [[*FAULTS, VANISH][k % (len(FAULTS) + 1)] for k in range(1, faults + 1)]
        calls = {reads: runs.calls(0, reads) for reads in {each.reads for each in faulty}}
        print(", ".join(f"{calls[r]} calls {'read' if r else 'write'}" for r in calls), flush=True)
        for number, fault in enumerate(faulty, 1):
            log = rng.randrange(2)
            last = rng.random() < 0.5 and not fault.reads  # the last calls publish
            at = rng.randint(max(calls[fault.reads] - 200, 1) if last else 1, calls[fault.reads])
            try:
                if fault == VANISH:
                    ended = runs.vanish(log, rng.uniform(0.0, VANISHES_WITHIN_S))
                else:
                    ended = runs.fail(log, fault, at)
            except AssertionError as error:
                ended = "FAULT"
                print(f"{number}: {fault} at {at}: {error}", flush=True)
                with contextlib.suppress(AssertionError):
                    runs.run(log)
            counts[fault.name, ended.partition(":")[0]] += 1
            print(f"{number} {fault.name} at call {at}: {ended}", flush=True)
    return counts


def main() -> None:
    """Let storage fail at random calls; print what came out."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--faults", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="failing-storage-") as folder:
        if "faulty.so" not in os.environ.get("LD_PRELOAD", ""):
            environment = {**os.environ, "LD_PRELOAD": str(library(Path(folder)))}
            sys.exit(subprocess.call([sys.executable, *sys.argv], env=environment))
        logging.disable()
        counts = fail_at_random(Path(folder), asked.faults, asked.seed)
    for what, count in sorted(counts.items()):
        print(f"{count:5} {', '.join(what)}")
    sys.exit(any(ended == "FAULT" for _, ended in counts))


if __name__ == "__main__":
    main()

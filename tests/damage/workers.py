"""Processes that judge damaged logs, one at a time each, and are killed where one hangs."""

import multiprocessing
import tempfile
import time
import traceback
from collections.abc import Iterable, Iterator
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, NamedTuple

from damage import cases
from damage.cases import Case
from damage.judge import Verdict, judge, warm_up

MAX_S = 30.0  # by the clock: other programs may hold the processors
START_S = 300.0  # of a process that has to compile
Asked = tuple[str, Any]  # the name of a function of `cases`, and its argument or arguments


class Answer(NamedTuple):
    """What was asked, the log that it stands for, and what came of it."""

    asked: Asked
    what: str
    promise: str
    verdict: Verdict


def judged(asked: Iterable[Asked], n_processes: int = 2) -> Iterator[Answer]:
    """Yield what comes of each case, as it comes; a process that hangs or dies is replaced."""
    waiting = iter(asked)
    busy: dict[Connection, _Worker] = {}
    try:
        for _ in range(n_processes):
            _give(_Worker(), waiting, busy)
        while busy:
            ready = wait(list(busy), timeout=1.0)
            for end in list(busy):
                worker = busy[end]
                if end in ready or worker.is_late():
                    del busy[end]
                    answer = worker.answer(end in ready)
                    _give(worker if answer.verdict.peak_bytes else _Worker(), waiting, busy)
                    yield answer
    finally:
        for worker in busy.values():
            worker.end()


def _give(worker: "_Worker", waiting: Iterator[Asked], busy: dict[Connection, "_Worker"]) -> None:
    asked = next(waiting, None)
    if asked is None:
        worker.end()
    else:
        worker.ask(asked)
        busy[worker.pipe] = worker


class _Worker:
    """A process, and what it was asked last."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.pipe, its_pipe = context.Pipe()
        self._process = context.Process(target=_work, args=(its_pipe,), daemon=True)
        self._process.start()
        its_pipe.close()
        if not self.pipe.poll(START_S):
            raise TimeoutError(f"a process did not start within {START_S:.0f} s")
        self.pipe.recv()
        self._asked: Asked = ("", None)
        self._since = 0.0

    def ask(self, asked: Asked) -> None:
        self._asked, self._since = asked, time.monotonic()
        self.pipe.send(asked)

    def is_late(self) -> bool:
        return time.monotonic() - self._since > MAX_S

    def answer(self, is_ready: bool) -> Answer:
        """Return the answer; without one the process is ended, and its peak of memory is 0."""
        what = "hung" if not is_ready else "died"
        if is_ready:
            try:
                return Answer(self._asked, *self.pipe.recv())
            except EOFError:
                self._process.join()
                what = f"died with code {self._process.exitcode}"
        self.end()
        return Answer(self._asked, "", "", Verdict(what, True, {}, 0.0, 0))

    def end(self) -> None:
        self.pipe.close()
        self._process.kill()
        self._process.join()


def _work(pipe: Connection) -> None:
    """Answer until the other end is closed."""
    warm_up()
    pipe.send("ready")
    with tempfile.TemporaryDirectory() as folder:
        while True:
            try:
                name, arguments = pipe.recv()
            except EOFError:
                return
            pipe.send(_answer(getattr(cases, name), arguments, Path(folder)))


def _answer(make: Any, arguments: Any, folder: Path) -> tuple[str, str, Verdict]:
    case = Case("cannot be made", b"", 0, cases.Promise.NONE)
    try:
        case = make(*arguments)
        verdict = judge(case, folder)
    except Exception:
        # Whatever is not an error of the product's own is what this looks for.
        verdict = Verdict(traceback.format_exc(), True, {}, 0.0, 1)
    return case.what, str(case.promise), verdict

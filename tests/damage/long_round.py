"""The long round: `python tests/damage/long_round.py --logs 20000` prints a table of results.

`--first 1234 --logs 1 --keep bad.mcap` makes the log of one number again.
"""

import argparse
import collections
import sys
import time
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for `damage` and `scenes`

from damage import bombs, cases, odd_values
from damage.workers import Answer, Asked, judged

GROUPS = {"case": "logs by number", "case_of_field": "odd values, each field",
          "case_of_bomb": "bombs"}  # fmt: skip


def main() -> int:
    """Judge the logs, print what is wrong as it comes, then the table; 1 if anything is."""
    options = _options()
    if options.keep:
        options.keep.write_bytes(cases.case(options.first).log)
    began, found = time.monotonic(), collections.Counter[tuple[str, str, str]]()
    most_cpu_s, max_bytes = 0.0, 0
    for answer in judged(_asked(options), options.processes):
        verdict = answer.verdict
        outcome = "FAULT" if verdict.fault else verdict.outcome
        found[GROUPS[answer.asked[0]], answer.promise, outcome] += 1
        most_cpu_s = max(most_cpu_s, verdict.cpu_s)
        max_bytes = max(max_bytes, verdict.peak_bytes)
        if verdict.fault:
            print(fault_line(answer), flush=True)
    print(table(found))
    print(f"most CPU for one log {most_cpu_s:.1f} s, most memory {max_bytes >> 20} MiB, "
          f"{time.monotonic() - began:.0f} s in all")  # fmt: skip
    return int(any(outcome == "FAULT" for *_, outcome in found))


def fault_line(answer: Answer) -> str:
    """Return what was asked, which log it was, and what is wrong."""
    return f"{answer.asked}: {answer.what} ({answer.promise}): {answer.verdict.outcome}"


def table(found: dict[tuple[str, str, str], int]) -> str:
    """Return the counts as a table in Markdown."""
    lines = ["| tried | what is known | outcome | logs |", "|---|---|---|---|"]
    lines += [f"| {' | '.join(key)} | {n:,} |" for key, n in sorted(found.items())]
    return "\n".join(lines)


def fields_and_bombs() -> list[Asked]:
    """Return all cases of odd values field by field, and of bombs."""
    fields = [
        ("case_of_field", (encoding, *field))
        for encoding in odd_values.ENCODINGS
        for field in odd_values.fields()
    ]
    return [*fields, *(("case_of_bomb", (name,)) for name in bombs.BOMBS)]


def _asked(options: argparse.Namespace) -> list[Asked]:
    numbers = range(options.first, options.first + options.logs)
    others = [] if options.first else fields_and_bombs()
    return [*others, *(("case", (number,)) for number in numbers)]


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--logs", type=int, default=20_000, help="how many logs by number")
    parser.add_argument("--first", type=int, default=0, help="the first number")
    parser.add_argument("--processes", type=int, default=1)
    parser.add_argument("--keep", type=Path, help="write the first log here")
    return parser.parse_args()


if __name__ == "__main__":
    sys.exit(main())

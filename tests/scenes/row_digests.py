"""Digests of the rows that a commit makes: run on two commits, the same lines are the same rows.

    python tests/scenes/row_digests.py [LOG...] > digests.txt

Without logs: the example, and a night that is simulated.
"""

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
COMMAND = "from epipole.flows.command_line.main import main; main()"
OF_THE_CODE = ("nights",)  # the table that tells by which code a night was made


def digests(log: Path, folder: Path) -> list[str]:
    """Run a log, and return a line for each table of each night."""
    out = folder / f"{log.stem}-out"
    subprocess.run(
        [sys.executable, "-c", COMMAND, "run", str(log), "--out", str(out), "--quiet"],
        check=True, env=os.environ | {"PREFECT_HOME": str(folder / "prefect")},
        stdout=subprocess.DEVNULL,
    )  # fmt: skip
    tables = [table for table in sorted(out.glob("night=*/*")) if table.name not in OF_THE_CODE]
    return [f"{log.stem} {t.parent.name} {t.name} {_digest(t)}" for t in tables]


def _digest(table: Path) -> str:
    found = hashlib.sha256()
    for part in sorted(table.iterdir()):
        found.update(part.read_bytes())
    return found.hexdigest()[:16]


def main() -> None:
    """Print the digests."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("logs", nargs="*", type=Path)
    asked = parser.parse_args().logs
    with tempfile.TemporaryDirectory(prefix="row-digests-") as name:
        folder = Path(name)
        if not asked:
            from epipole.flows.simulate import simulate

            simulate("four_sensor_geo", folder / "simulated.mcap", seed=5)
            asked = [ROOT / "examples" / "four_sensor_geo.mcap", folder / "simulated.mcap"]
        for log in asked:
            print("\n".join(digests(log, folder)), flush=True)


if __name__ == "__main__":
    main()

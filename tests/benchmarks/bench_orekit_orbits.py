"""Orekit reads the exported messages and fits orbits: do they agree with the truth?

    python tests/benchmarks/bench_orekit_orbits.py [LOG...] [--work FOLDER] [--medians]

The fit is that of `examples/orekit_orbits.py` (needs the extra `orekit`): the TDMs of a night, the
sensors' ephemerides beside them, and each direction's own sigmas from `observations`. With
--medians, the messages alone. Without a log: the example's. Each log has its truth beside it.
With --work, datasets and messages are kept there, and used again.

Wanted: every object with arc enough converges, chi2 per degree of freedom 0.8 to 1.2.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np
import polars as pl
from whole_runs import whole_run

sys.path.append(str(Path(__file__).parents[1]))  # what tests share
from scenes.orekit_fits import orekit_fits

LOG = Path(__file__).parents[2] / "examples" / "four_sensor_geo.mcap"
HEADER = (
    "log                        objects  enough  converged    left out  "
    "chi2/dof by object   pooled  NEES/6  error [km]"
)


def fits_of(log: Path, folder: Path, medians: bool) -> pl.DataFrame:
    """Return the fits of a log; its dataset and messages are in the folder, or are made there."""
    if not (folder / "out").exists():
        whole_run(log, folder / "out", {}, lambda _: 0.0)
    return orekit_fits(log, folder / "out", folder / "tdm", medians)


def line(name: str, fits: pl.DataFrame) -> str:
    """Return the line of a log."""
    enough = fits.filter("enough")
    good = enough.filter("converged")
    ratio = (good["chi2"] / good["freedom"]).to_numpy()
    pooled = good["chi2"].sum() / good["freedom"].sum()
    left_out = f"{(2 * good['directions'] - 6 - good['freedom']).sum() // 2} of "
    left_out += str(good["directions"].sum())
    chi2 = f"{np.median(ratio):.2f} ({ratio.min():.2f} to {ratio.max():.2f})"
    return (
        f"{name:26} {len(fits):7} {len(enough):7} {len(good):10} "
        f"{left_out:>11}  {chi2:19} {pooled:7.3f} "
        f"{good['nees'].mean():7.2f} {good['km'].median():11.3f}"
    )


def main() -> None:
    """Print a line per log, and all together."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("logs", nargs="*", type=Path, default=[LOG])
    parser.add_argument("--work", type=Path, help="folder that keeps datasets and messages")
    parser.add_argument("--medians", action="store_true", help="the median sigmas of the messages")
    asked = parser.parse_args()
    of_logs = []
    print(HEADER, flush=True)
    with tempfile.TemporaryDirectory() as name:
        for log in asked.logs:
            folder = (asked.work or Path(name)) / log.stem
            of_logs.append(fits_of(log, folder, asked.medians))
            print(line(log.stem, of_logs[-1]), flush=True)
    print(line("all", pl.concat(of_logs)))


if __name__ == "__main__":
    main()

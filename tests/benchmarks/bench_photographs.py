"""Star identification on photographs: lists of measured places, by a lens known by its name alone.

    python tests/benchmarks/bench_photographs.py tests/photographs/great_bear.csv --width 5184 \
        --height 3456 --field 25.9 --year 2011

A list has the columns x_px, y_px (places measured in a photograph) and may have star_id (the
Hipparcos numbers that somebody else found, empty where none). The camera is a pinhole with the
stated field along the columns, which a lens's nominal focal length gives to some per cent only:
it is tried in steps on both sides. No brightness, no date but the year, no centroid error is
told. An answer is right where it agrees with the list's numbers; all steps but those at the true
scale should be refused. `tests/photographs` has two lists and says where they come from.
"""

import argparse
import csv
import time
from pathlib import Path

import numpy as np

from epipole.io.catalogues.hipparcos import read_hipparcos
from epipole.schemas.arrays import Array, Integers
from epipole.schemas.settings import Settings
from epipole.tasks.algorithms.geometry.camera import Camera, pixel_angle, unproject
from epipole.tasks.algorithms.geometry.directions import boresight_angles
from epipole.tasks.algorithms.star_identification.centroids import RawCentroids
from epipole.tasks.algorithms.star_identification.frame import MatchSettings, field_of_view
from epipole.tasks.algorithms.star_identification.sensor import IdentifiedSensor, identify_sensor
from epipole.tasks.algorithms.star_identification.sequence import no_priors
from epipole.tasks.identify.cache_skies import CachedSkies, Catalogue

DEFAULT = Settings().identification
HOW = MatchSettings(DEFAULT.gate_sigma, -np.log(DEFAULT.false_alarm), DEFAULT.time_limit_s, np.nan)


def read_list(path: Path) -> tuple[Array, Array, Integers]:
    """Return x, y [px] and the star numbers, 0 where none is given."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    x, y = (np.array([float(row[name]) for row in rows]) for name in ("x_px", "y_px"))
    return x, y, np.array([int(row.get("star_id") or 0) for row in rows])


def identify(
    x_px: Array, y_px: Array, camera: Camera, catalogue: Catalogue, day: int
) -> IdentifiedSensor:
    """Return the default method's result for one frame without brightness."""
    unknown = np.full(len(x_px), np.nan)
    u = unproject(camera, x_px, y_px)
    optics = field_of_view(camera)
    raw = RawCentroids(
        np.array([0, len(u)]), u, pixel_angle(camera, u), unknown, unknown, np.zeros((1, 3)),
        [optics], np.zeros(1, np.int64),
    )  # fmt: skip
    skies = CachedSkies(catalogue, day, camera.pixel_rad, 2.0)
    return identify_sensor(np.zeros(1), raw, no_priors(1), skies, None, HOW)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("list", type=Path)
    parser.add_argument("--width", type=int, required=True)
    parser.add_argument("--height", type=int, required=True)
    parser.add_argument("--field", type=float, required=True, help="stated, degrees")
    parser.add_argument("--year", type=int, required=True)
    parser.add_argument("--reach", type=float, default=8.0, help="per cent either side")
    parser.add_argument("--step", type=float, default=0.25, help="per cent")
    arguments = parser.parse_args()
    x_px, y_px, known = read_list(arguments.list)
    catalogue = Catalogue(read_hipparcos())
    day = int(np.datetime64(f"{arguments.year}-07-01").astype(int))
    focal = arguments.width / 2 / np.tan(np.radians(arguments.field) / 2)
    middle = (arguments.width - 1) / 2, (arguments.height - 1) / 2
    tried, refused = np.arange(-arguments.reach, arguments.reach + 1e-9, arguments.step), 0
    started = time.process_time()
    print("focal length %  stars  as listed  otherwise  ra dec roll, degrees  error px")
    for percent in tried:
        f = focal * (1 + percent / 100)
        camera = Camera(arguments.width, arguments.height, f, f, *middle)
        found = identify(x_px, y_px, camera, catalogue, day)
        solution = found.solutions.frame(0)
        if solution is None:
            refused += 1
            continue
        star = solution.star
        star_id = np.where(star >= 0, found.sky.catalogue.star_id[star], 0)
        listed = (known > 0) & (star_id > 0)
        ra, dec, roll = np.degrees(boresight_angles(solution.R_sensor_from_icrs))
        print(
            f"{percent:+14.2f}  {np.sum(star_id > 0):5d}  {np.sum(listed & (star_id == known)):9d}"
            f"  {np.sum(listed & (star_id != known)):9d}"
            f"  {ra:.3f} {dec:.3f} {roll:.2f}  {np.median(found.sigma_scale):.2f}"
        )
        for k in np.flatnonzero(listed & (star_id != known)):
            print(f"    ({x_px[k]:g}, {y_px[k]:g}): listed {known[k]}, found {star_id[k]}")
    seconds = (time.process_time() - started) / len(tried)
    print(f"{refused} of {len(tried)} focal lengths refused; {1e3 * seconds:.0f} ms of CPU each")


if __name__ == "__main__":
    main()

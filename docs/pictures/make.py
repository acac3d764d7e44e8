"""Draw all pictures of the pages again, from the example's dataset and truth.

python docs/pictures/make.py [DATASET]      # out/ if none is named
"""

import sys
from pathlib import Path

from concepts_of_objects import (
    draw_clocks,
    draw_first_night,
    draw_gates,
    draw_planes,
    draw_sigma,
    draw_triangulation,
)
from concepts_of_stars import draw_boresight, draw_optics, draw_votes
from figures import draw_association, draw_identification, draw_positions, draw_tracking
from night import read_night
from overlaid import draw_overlay
from pipeline import draw_pipeline
from style import save

FOLDER = Path(__file__).parent
TRUTH = FOLDER.parents[1] / "examples" / "four_sensor_geo.mcap.truth"
PICTURES = {
    "pipeline": draw_pipeline,
    "identification": draw_identification,
    "tracking": draw_tracking,
    "association": draw_association,
    "positions": draw_positions,
    "boresight": draw_boresight,
    "clocks": draw_clocks,
    "first_night": draw_first_night,
    "gates": draw_gates,
    "optics": draw_optics,
    "overlay": draw_overlay,
    "planes": draw_planes,
    "sigma": draw_sigma,
    "triangulation": draw_triangulation,
    "votes": draw_votes,
}


def make(dataset: Path, folder: Path) -> None:
    """Write every picture into a folder."""
    night = read_night(dataset, TRUTH)
    for name, draw in PICTURES.items():
        save(draw(night), folder / f"{name}.png")


if __name__ == "__main__":
    make(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else FOLDER)

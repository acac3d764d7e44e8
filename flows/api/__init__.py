"""The public names for notebooks and scripts: logs, frames, objects, orbits, datasets.

    from epipole.flows import api

These names keep their meaning from version to version; all others may change. They call what the
nightly run calls. Units stand in the names, frames in the docstrings.
"""

from importlib.metadata import version

from epipole.flows.api.datasets import Dataset, open_dataset
from epipole.flows.api.frames import IdentifiedFrame, identify_frame, view_frame
from epipole.flows.api.logs import LogTables, read_log, write_log
from epipole.flows.api.objects import FoundObjects, Positions, View, associate, triangulate
from epipole.flows.api.orbits import Attributable, ObjectOrbit, attributable, fit_orbit, link
from epipole.tasks.algorithms.geometry.camera import Camera

__version__ = version("epipole")

__all__ = [
    "Attributable",
    "Camera",
    "Dataset",
    "FoundObjects",
    "IdentifiedFrame",
    "LogTables",
    "ObjectOrbit",
    "Positions",
    "View",
    "__version__",
    "associate",
    "attributable",
    "fit_orbit",
    "identify_frame",
    "link",
    "open_dataset",
    "read_log",
    "triangulate",
    "view_frame",
    "write_log",
]

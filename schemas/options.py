"""What settings and commands choose among: star catalogues, methods, runners, kinds of messages.

A registry has one line for each choice: its name and "module:function". Functions of one registry
have one call signature, which the registry's comment states. Settings accept these names. A module
is imported when it is used.
"""

from collections.abc import Mapping
from enum import StrEnum
from importlib import import_module
from typing import Any

_STARS = "epipole.tasks.algorithms.star_identification"
_LINKING = "epipole.tasks.algorithms.tracking.linking"
_ASSOCIATION = "epipole.tasks.solve.associate_objects"

# (t_s, frames, priors, skies, magnitude_limit, how) -> IdentifiedSensor, as `identify_sensor`.
STAR_IDENTIFICATION = {
    "likelihood": f"{_STARS}.sensor:identify_sensor",
    "four_base_stars": f"{_STARS}.published.four_base_stars:identify_by_four_base_stars",
    "match_group": f"{_STARS}.published.match_group:identify_by_match_group",
    "radial_cyclic": f"{_STARS}.published.radial_cyclic:identify_by_radial_cyclic",
}

# (fragments, rule) -> Links, as `link_by_likelihood`.
TRACK_LINKING = {
    "likelihood_ratio": f"{_LINKING}.likelihood_ratio:link_by_likelihood",
    "prediction": f"{_LINKING}.prediction:link_by_prediction",
    "none": f"{_LINKING}.chains:leave_unlinked",
}

# (samples, focal_px, settings) -> Groups, as `associate_by_likelihood`.
ASSOCIATION = {
    "likelihood": f"{_ASSOCIATION}:associate_by_likelihood",
    "epipolar": f"{_ASSOCIATION}:associate_by_epipolar_lines",
}


def load_method(registry: Mapping[str, str], name: str) -> Any:
    """Return the function that a registry has under a name; its module is imported."""
    module, _, function = registry[name].partition(":")
    return getattr(import_module(module), function)


# Choices of commands.


class Runner(StrEnum):
    """Threads of this process, or Dask's processes on this machine or on others."""

    threads = "threads"
    dask = "dask"


class Message(StrEnum):
    """A kind of CCSDS message: tracking data, an ephemeris, a state."""

    tdm = "tdm"
    oem = "oem"
    opm = "opm"

    @property
    def table(self) -> str:
        """The table that it is made from."""
        return "observations" if self is Message.tdm else "states"

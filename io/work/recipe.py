"""Recipes: what a night is made from and with. From one recipe always comes the same night."""

import hashlib
from collections.abc import Iterable
from functools import lru_cache
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from epipole.schemas.options import catalogue_of_runs
from epipole.schemas.settings import Settings

# Another version may change the last bits of a result; that of the table of the Earth's orientation
# where sensors are, and that of SGP4 which object has which name.
LIBRARIES = ("astropy-iers-data", "numba", "numpy", "polars", "pyarrow", "pyerfa", "scipy", "sgp4")


class Recipe(NamedTuple):
    """What a night is made from and with, but for the nights before it: digests."""

    logs: str
    settings: str
    star_catalogue: str
    code: str
    known: str | None = None  # the catalogue of known objects

    @property
    def made_with(self) -> str:
        """A digest of what the parts of any logs depend on."""
        return digest_of((self.settings, self.star_catalogue, self.code))[:16]

    def work_key(self, night: str, run: Iterable[str] = ()) -> str:
        """Return a digest of all that the parts of a night depend on; names are given later.

        `run` are the sensors and logs of the run, also of other nights: parts lie under the numbers
        of sensors in the run, and a calibration holds from its log on.
        """
        whole = (self.logs, self.settings, night, self.star_catalogue, self.code, *run)
        return digest_of(whole)[:16]


def recipe_of(logs: str, settings: Settings, known: str | None = None) -> Recipe:
    """Return the recipe of this program with these logs (`logs_key`) and settings.

    `known` is the digest of the catalogue of known objects.
    """
    catalogue = star_catalogue_key(settings.identification.catalogue)
    return Recipe(logs, settings.key(), catalogue, code_key(), known)


def logs_key(logs: Iterable[tuple[str, str]]) -> str:
    """Return a digest of logs, each with its name and its SHA-256.

    Names count: where frames contradict each other, the names of their logs decide which is used.
    Of those with the same bytes the first name counts.
    """
    by_content: dict[str, str] = {}
    for name, sha256 in sorted(logs):
        by_content.setdefault(sha256, name)
    return digest_of(sorted(f"{sha256} {name}" for sha256, name in by_content.items()))


def star_catalogue_key(which: str) -> str:
    """Return a digest of a run's star catalogue: a file's content may change, its name not."""
    if (source := catalogue_of_runs(which)) is not None:
        return f"{which} {metadata.version(source.package)}"
    with open(which, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@lru_cache(maxsize=1)
def code_key() -> str:
    """Return a digest of this program's files and of the versions of its libraries."""
    digest = hashlib.sha256()
    for name in LIBRARIES:
        digest.update(f"{name} {metadata.version(name)}\0".encode())
    for name in ("schemas", "io", "tasks", "flows"):
        folder = Path(__file__).resolve().parents[2] / name
        for file in sorted(folder.rglob("*.py")):
            digest.update(str(file.relative_to(folder)).encode() + b"\0" + file.read_bytes())
    return digest.hexdigest()


def digest_of(parts: Iterable[str]) -> str:
    """Return one digest of several texts."""
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part.encode() + b"\0")
    return digest.hexdigest()

"""The stages of a night, in their order, each with one name and a sentence.

The name is the same everywhere: package in `tasks/`, Prefect tasks, progress line, folder in the
work folder, and the column `stage` of `rejects`.
"""

from enum import StrEnum
from typing import Self


class Declared(StrEnum):
    """Names that are declared once, each with a `sentence` that says what it means."""

    sentence: str

    def __new__(cls, name: str, sentence: str) -> Self:
        """Return a member whose value is the name alone."""
        member = str.__new__(cls, name)
        member._value_ = name
        member.sentence = sentence
        return member


class Stage(Declared):
    """A stage of the nightly flow; `sentence` says what it does."""

    READ = (
        "read",
        "Reads any number of logs, in any order and with overlap; damage is skipped and counted.",
    )
    IDENTIFY = (
        "identify",
        "Finds where each sensor was, which centroids are stars, and the attitude of each frame.",
    )
    CALIBRATE = (
        "calibrate",
        "Fits each sensor's optics to its stars; sensors whose optics differ are identified again.",
    )
    TRACK = (
        "track",
        "Follows detections that are no stars from frame to frame, and joins fragments of tracks.",
    )
    SOLVE = (
        "solve",
        "Finds which tracklets of different sensors show one object, and solves its positions and "
        "states.",
    )
    CHECK = (
        "check",
        "Judges each sensor's clock, ephemeris and attitude; a wrong one takes part without "
        "its fault, and a wrong clock sends the night back to `track`.",
    )
    NAME = (
        "name",
        "Gives each object one id for the whole night, also across gaps and midnight, and its "
        "name in a catalogue of known objects.",
    )
    PUBLISH = (
        "publish",
        "Fits the orbits, writes the tables of each night and puts them in place at once.",
    )

"""Choices that commands offer: what runs the tasks, which message is written."""

from enum import StrEnum


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

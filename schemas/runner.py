"""What runs the tasks of a run."""

from enum import StrEnum


class Runner(StrEnum):
    """Threads of this process, or Dask's processes on this machine or on others."""

    threads = "threads"
    dask = "dask"

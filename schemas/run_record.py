"""The record of a night's last run: how it ended, and what it took. It lies beside the nights."""

import pyarrow as pa

from epipole.schemas.columns import column, schema, time_column
from epipole.schemas.stages import Declared
from epipole.schemas.tables import TEXTS


class RunState(Declared):
    """How the last run of a night ended."""

    MADE = "made", "The night is published."
    NO_FRAMES = "no frames", "The logs have no frames of the night."
    FAILED = "failed", "The message says why; what was published before stays."


RUNS = schema(
    "runs",
    "One row per file: how the last run of a night ended. It belongs to no night, as nights that "
    "failed have none.",
    [
        column("night", pa.string(), doc="UTC date."),
        column("state", pa.string(), doc="How it ended: a `RunState`."),
        column("message", pa.string(), doc="What was found, or why nothing was."),
        column("needs_look", TEXTS, doc="What needs a look, a sentence each."),
        time_column("ended", doc="When it ended, UTC."),
        column("duration_s", pa.float64(), unit="s", doc="How long it took."),
        column("cpu_s", pa.float64(), unit="s", doc="CPU of its process; Dask's have theirs."),
        column("memory_mib", pa.float64(), unit="MiB", doc="Peak memory of its process."),
        column("run_id", pa.string(), null=True, doc="Id of Prefect's run; null without Prefect."),
        column("host", pa.string(), doc="Name of the machine."),
        column("versions", pa.string(), doc="Of epipole, Python and libraries."),
        column("settings", TEXTS, doc="Settings that are not the defaults."),
    ],
)

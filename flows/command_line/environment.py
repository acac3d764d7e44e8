"""The environment of a command, made fit before Prefect is imported: it reads it only then."""

import os
import warnings
from pathlib import Path

from epipole.io.caches.private_folders import private_folder


def prepare_environment() -> None:
    """Switch off what Prefect reports about its users, and give a home to a user without one.

    DO_NOT_TRACK covers Prefect's client, and `epipole.flows.prefect.defaults` its server. Where
    the user has set DO_NOT_TRACK, it stays as it is.
    """
    os.environ.setdefault("DO_NOT_TRACK", "1")
    # Where Prefect's home cannot be made, the embedded server says so.
    warnings.filterwarnings("ignore", "Failed to create the Prefect home")
    try:
        Path.home()
    except RuntimeError:  # the user of a container need not be known to it
        os.environ["HOME"] = str(private_folder("home"))

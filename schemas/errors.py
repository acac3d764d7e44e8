"""Errors and warnings that a user can put right.

Each message says what is wrong, where, and what to do.

The command line prints the message as one line and exits with a non-zero code. Any other error
is a fault of the program and shows its traceback.
"""


class EpipoleError(ValueError):
    """Base of all errors that a user can put right."""


class LogError(EpipoleError):
    """A log that cannot be used: missing, not MCAP, without frames, of an unknown encoding."""


class NoFramesError(LogError):
    """Logs that have no frames of the night that is asked for."""


class SettingsError(EpipoleError):
    """A settings file that cannot be read, or an invalid setting."""


class SceneError(EpipoleError):
    """A simulation scene that is missing or invalid."""


class CatalogueError(EpipoleError):
    """A catalogue, of stars or of known objects, that is missing or invalid."""


class DatasetError(EpipoleError):
    """An output folder that is not a dataset, or that cannot be read or written."""


class ReportError(EpipoleError):
    """A report that cannot be drawn or written."""


class LogWarning(UserWarning):
    """A log that is written, and holds a mistake or what a reader leaves out."""

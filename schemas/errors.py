"""The errors a user can cause, each with a message of what, where and what to do.

The command line prints the message as one line and exits with a non-zero code; anything
else that is raised is a fault of the program and shows its traceback.
"""


class EpipoleError(ValueError):
    """Base of every error that the user, not the program, has to mend."""


class LogError(EpipoleError):
    """A log that cannot be read: missing, no MCAP, without frames, of an unknown encoding."""


class SettingsError(EpipoleError):
    """A settings file or value that does not fit."""


class SceneError(EpipoleError):
    """A simulation scene that does not fit."""


class CatalogueError(EpipoleError):
    """A star catalogue that is missing or malformed."""


class DatasetError(EpipoleError):
    """An output folder that is no dataset, or that cannot be published to."""

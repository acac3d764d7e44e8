"""`epipole settings`: all settings."""

import typer


def settings() -> None:
    """Print all settings with their defaults, as TOML for `epipole run --settings`."""
    from epipole.io.settings_file import settings_text
    from epipole.schemas.settings import Settings

    typer.echo(settings_text(Settings()), nl=False)

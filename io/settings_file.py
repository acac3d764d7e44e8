"""Settings files: TOML in, commented TOML out."""

import json
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from epipole.io.paths import known_as, open_remote, refuse_device
from epipole.schemas.errors import LogError, SettingsError
from epipole.schemas.given_settings import parse_settings, validate_settings, with_assumptions
from epipole.schemas.settings import Group, Settings

WIDTH = 88


def read_settings(path: Path) -> Settings:
    """Return the settings of a TOML file. A setting that it does not have keeps its default.

    Raises
    ------
    SettingsError
        Where the file cannot be read, or a setting is invalid or unknown.
    """
    try:
        refuse_device(path)
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise SettingsError(
            f"{path}: not a text file; `epipole settings` prints a file to start from"
        ) from error
    except OSError as error:
        raise SettingsError(
            f"{path}: {error.strerror}; `epipole settings` prints a file to start from"
        ) from error
    return parse_settings(text, str(path))


def run_settings(path: Path | None, assume: Sequence[str]) -> Settings:
    """Return the settings of a run: those of a TOML file, or the defaults, with assumptions.

    Raises
    ------
    SettingsError
        As `read_settings` and `with_assumptions`.
    """
    return with_assumptions(read_settings(path) if path else Settings(), assume)


def merged_settings(file: str | None, given: Settings) -> Settings:
    """Return the settings of a file, with those that were given instead of some.

    Where both leave a setting out, it keeps its default.

    Raises
    ------
    SettingsError
        As `read_settings`; also where what was given contradicts the file.
    """
    if file is None:
        return given
    below = _read(file).model_dump(exclude_unset=True)
    for group, values in given.model_dump(exclude_unset=True).items():
        below[group] = {**below.get(group, {}), **values}
    return validate_settings(below, f"{file} and the settings given")


def _read(file: str) -> Settings:
    """Return the settings of a local file or of an fsspec URL."""
    if "://" not in file:
        return read_settings(Path(file))
    file = known_as(file)
    try:
        size, read, _ = open_remote(file)
        text = read(0, size).decode()
    except (LogError, UnicodeDecodeError) as error:
        raise SettingsError(f"settings {file}: {error}") from error
    return parse_settings(text, file)


def settings_text(settings: Settings) -> str:
    """Return the settings as commented TOML for `read_settings`.

    A setting without a value is commented out, because TOML has no null.
    """
    lines = ["# Settings of epipole. A setting that is left out keeps its default."]
    for name in type(settings).model_fields:
        group: Group = getattr(settings, name)
        lines += ["", *_comment((type(group).__doc__ or "").strip()), f"[{name}]"]
        for key, field in type(group).model_fields.items():
            value = getattr(group, key)
            setting = f"# {key} =" if value is None else f"{key} = {_toml(value)}"
            lines += [*_comment(field.description or ""), setting]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    """Return a value in TOML. A group inside a list is an inline table."""
    if isinstance(value, Group):
        inside = (f"{key} = {_toml(getattr(value, key))}" for key in type(value).model_fields)
        return f"{{ {', '.join(inside)} }}"
    if isinstance(value, tuple | list):
        if any(isinstance(item, Group) for item in value):
            return "[\n" + "".join(f"    {_toml(item)},\n" for item in value) + "]"
        return f"[{', '.join(map(_toml, value))}]"
    return json.dumps(value)


def _comment(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent="# ", subsequent_indent="# ")

"""Settings as they are given: TOML, flow parameters, options; and what is wrong with them."""

from collections.abc import Sequence
from difflib import get_close_matches
from typing import Any

from pydantic import ValidationError

from epipole.schemas.errors import SettingsError
from epipole.schemas.settings import Settings
from epipole.schemas.text import as_line, toml_values

LONGEST_VALUE = 80  # of an invalid value in a message


def parse_settings(text: str, where: str) -> Settings:
    """Return the settings of a TOML text; `where` names it in messages.

    Raises
    ------
    SettingsError
        Names the setting, the value given and the value expected.
    """
    try:
        values = toml_values(text)
    except ValueError as error:
        raise SettingsError(f"{where}: not TOML: {error}") from error
    return validate_settings(values, where)


def validate_settings(values: dict[str, Any], where: str) -> Settings:
    """Return the settings of nested mappings, such as flow parameters; see `parse_settings`."""
    try:
        return Settings.model_validate(values)
    except ValidationError as error:
        raise SettingsError(f"{where}: {_first_fault(error)}") from error


def with_assumptions(settings: Settings, texts: Sequence[str]) -> Settings:
    """Return settings with further assumptions, such as ``sat1.time=gps`` or ``*.states=TEME``.

    Raises
    ------
    SettingsError
        Where a text is not SENSOR.NAME=VALUE, or the value is not one of the name.
    """
    added: dict[str, dict[str, str]] = {}
    for text in texts:
        reading, _, value = text.partition("=")
        sensor, _, name = reading.rpartition(".")
        if not (sensor and name and value):
            raise SettingsError(
                f"--assume {as_line(text, LONGEST_VALUE)}: not SENSOR.NAME=VALUE, such as "
                "sat1.time=gps"
            )
        added.setdefault(sensor, {"sensor": sensor})[name] = value
    values = settings.model_dump()
    values["sensors"]["assume"] = [*values["sensors"]["assume"], *added.values()]
    return validate_settings(values, "--assume")


def _first_fault(error: ValidationError) -> str:
    fault = error.errors()[0]
    if not fault["loc"] and "ctx" in fault:  # of several settings
        return str(fault["ctx"]["error"])
    name = as_line(".".join(str(part) for part in fault["loc"]), LONGEST_VALUE)
    value = as_line(repr(fault["input"]), LONGEST_VALUE)
    if fault["type"] == "extra_forbidden":
        return f"unknown setting {name}{_meant(name)}; `epipole settings` lists them all"
    return f"{name} = {value}: {fault['msg'][0].lower()}{fault['msg'][1:]}"


def _meant(unknown: str) -> str:
    """Return the group, or the setting of its group, that is most like an unknown name."""
    group, _, key = unknown.rpartition(".")
    fields = Settings.model_fields
    if group in fields and (settings := fields[group].annotation) is not None:
        names = list(settings.model_fields)
    else:
        names, key = list(fields), unknown
    near = get_close_matches(key, names, n=1)
    if not near:  # it may be a setting of another group
        groups = Settings().model_dump()
        whole = {name: f"{g}.{name}" for g, values in groups.items() for name in values}
        near = [whole[name] for name in get_close_matches(key.rpartition(".")[2], whole, n=1)]
    return f" (did you mean {near[0]}?)" if near else ""

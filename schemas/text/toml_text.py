"""TOML texts: every text that is no TOML is a ValueError."""

import tomllib
from typing import Any

DEEPEST = 50  # levels of tables and lists; no file of ours has more than four
_TOO_DEEP = "brackets or dotted keys are nested too deep"


def toml_values(text: str) -> dict[str, Any]:
    """Return the nested mappings of a TOML text.

    Raises
    ------
    ValueError
        Where it is not TOML, is nested too deep, or has a number of thousands of digits.
    """
    try:
        values = tomllib.loads(text)
    except RecursionError:
        raise ValueError(_TOO_DEEP) from None
    _check_depth(values)
    return values


def _check_depth(values: dict[str, Any]) -> None:
    """Raise where values are nested too deep: not even a message could show them then."""
    level: list[Any] = [values]
    for _ in range(DEEPEST):
        if not level:
            return
        level = [inner for outer in level for inner in _inside(outer)]
    raise ValueError(_TOO_DEEP)


def _inside(value: Any) -> list[Any]:
    """Return the tables and lists directly in a value."""
    inside = value.values() if isinstance(value, dict) else value
    return [inner for inner in inside if isinstance(inner, dict | list)]

"""Settings files with one odd value in them, and settings at the bounds of what is allowed."""

from collections.abc import Iterator
from typing import Any

from annotated_types import Ge, Gt, Le, Lt

from epipole.schemas.errors import SettingsError
from epipole.schemas.given_settings import parse_settings
from epipole.schemas.settings import Settings

# As TOML: numbers beyond all bounds, values of other types, text that nobody can print.
ODD = (
    "nan", "inf", "-inf", "0", "0.0", "-0.0", "-1", "1", "1e300", "-1e300", "1e-300", "1e-320",
    "9223372036854775807", "99999999999999999999999999", "0.5", "true", '""', '" "', '"0"',
    '"\\u0000"', '"\\u001b[31m"', '"../../x"', f'"{"x" * 100_000}"', "[]", "[1]", "[[]]", "{}",
    "{ a = 1 }", "2019-04-01", "[{ lowest_km = nan, highest_km = 1, share = 0.1 }]",
)  # fmt: skip
WHOLE = (
    "", "\0", "[", "[sensors", "a = 1", "[nobody]\na = 1", "sensors = 1", "[sensors]\n[sensors]",
    "[sensors]\nnobody = 1", "[sensors.a.b]\nc = 1", "a." * 5000 + "b = 1",
    "[work]\nmemory_mib = " + "9" * 5000, "x = " + "[" * 5000, "x = " + "[" * 5000 + "]" * 5000,
)  # fmt: skip
NEAR = 1e-9  # of a bound that is not allowed itself, as a share of it


def fields() -> Iterator[tuple[str, str, Any]]:
    """Yield each setting: its group, its name, and what is declared of it."""
    for group, of in Settings.model_fields.items():
        for name, field in of.annotation.model_fields.items():
            yield group, name, field


def texts() -> Iterator[str]:
    """Yield the texts of all odd settings files."""
    yield from WHOLE
    for group, name, _ in fields():
        for value in ODD:
            yield f"[{group}]\n{name} = {value}\n"


def taken(text: str) -> Settings | None:
    """Return the settings of a text, or None where it is refused; in one line, or it is a fault."""
    try:
        return parse_settings(text, "settings.toml")
    except SettingsError as error:
        line = str(error)
        if "\n" in line or not line.isprintable() or len(line) > 1000:
            raise AssertionError(f"{text[:80]!r} is refused by {line[:1000]!r}") from error
        return None


def extremes() -> list[tuple[str, str, Any]]:
    """Return each number at its least and greatest allowed value: group, name, value."""
    found = []
    for group, name, field in fields():
        for bound in field.metadata:
            if isinstance(bound, Ge | Le):
                found.append((group, name, getattr(bound, "ge", getattr(bound, "le", None))))
            elif isinstance(bound, Gt):
                found.append((group, name, max(abs(bound.gt), 1e-12) * NEAR + bound.gt))
            elif isinstance(bound, Lt):
                found.append((group, name, bound.lt * (1 - NEAR)))
    return found

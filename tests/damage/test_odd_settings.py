"""Odd settings files are refused in one line, or taken with values in their bounds."""

import math

import pytest

from damage import odd_settings
from epipole.schemas.errors import SettingsError
from epipole.schemas.given_settings import parse_settings
from epipole.schemas.settings import Settings


def test_every_odd_settings_file_is_taken_or_refused_in_one_line():
    taken = [odd_settings.taken(text) for text in odd_settings.texts()]
    n_taken = sum(settings is not None for settings in taken)
    assert 0 < n_taken < len(taken) / 4
    assert all(_is_finite(settings) for settings in taken if settings is not None)


def test_settings_at_their_bounds_are_valid():
    groups = {(group, name) for group, name, _ in odd_settings.extremes()}
    for group, name, value in odd_settings.extremes():
        kind = Settings.model_fields[group].annotation.model_fields[name].annotation
        whole = int(value) if kind is int else value
        odd_settings.taken(f"[{group}]\n{name} = {whole!r}\n")
    assert len(groups) > 30


@pytest.mark.parametrize("text", ["a." * 5000 + "b = 1", "a = " + "[" * 60 + "]" * 60])
def test_a_settings_file_that_is_nested_too_deep_is_refused(text):
    with pytest.raises(SettingsError, match=r"^here: not TOML: .* nested too deep$"):
        parse_settings(text, "here")


def _is_finite(settings):
    groups = settings.model_dump().values()
    numbers = [v for group in groups for v in group.values() if isinstance(v, int | float)]
    return all(math.isfinite(number) for number in numbers)

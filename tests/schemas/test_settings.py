"""Settings have bounds, and do not contradict each other."""

import pytest
from annotated_types import Ge, Gt, Le, Lt

from epipole.schemas.errors import SettingsError
from epipole.schemas.given_settings import parse_settings, validate_settings
from epipole.schemas.settings import Settings

NUMBERS = [
    (group, name, field)
    for group, of in Settings.model_fields.items()
    for name, field in of.annotation.model_fields.items()
    if field.annotation in (int, float, int | None, float | None)
]


@pytest.mark.parametrize("value", [1e308, -1e308])
@pytest.mark.parametrize(
    ("group", "name"), [(group, name) for group, name, _ in NUMBERS], ids=lambda part: part
)
def test_no_number_may_be_absurd(group, name, value):
    with pytest.raises(SettingsError, match=rf"^here: {group}\.{name} = "):
        validate_settings({group: {name: value}}, "here")


@pytest.mark.parametrize(
    ("group", "name", "field"), NUMBERS, ids=[f"{g}.{n}" for g, n, _ in NUMBERS]
)
def test_the_bounds_of_a_number_are_allowed_where_they_say_so(group, name, field):
    kinds = {type(bound) for bound in field.metadata}
    assert kinds & {Ge, Gt}
    assert kinds & {Le, Lt}


SHELL = "{{ lowest_km = {}, highest_km = {}, share = {} }}"


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (
            f"shells = [{SHELL.format(900, 300, 0.2)}]",
            "lowest_km = 900 is not below highest_km = 300",
        ),
        (f"shells = [{SHELL.format(300, 300, 0.2)}]", "lowest_km = 300 is not below"),
        (f"shells = [{SHELL.format(1, 2, 0.6)}, {SHELL.format(3, 4, 0.5)}]", "add up to 1.1,"),
        ("min_altitude_km = 5e5", r"min_altitude_km = 500000 is not below .*max_range_km = 100000"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(text, says):
    with pytest.raises(SettingsError, match=rf"^here: association\..*{says}"):
        parse_settings(f"[association]\n{text}", "here")


def test_a_flow_gets_the_same_checks():
    with pytest.raises(ValueError, match="is not below"):
        Settings.model_validate({"association": {"min_altitude_km": 2e5}})


@pytest.mark.parametrize(
    ("values", "meant"),
    [
        ({"sensors": {"state_gap": 1}}, "state_gap_s"),
        ({"sensor": {}}, "sensors"),
        ({"max_rate_deg": 4}, "tracklets.max_rate_deg_s"),
        ({"sensors": {"max_rate_deg_s": 4}}, "tracklets.max_rate_deg_s"),
    ],
)
def test_a_misspelt_or_misplaced_setting_has_a_suggestion(values, meant):
    with pytest.raises(SettingsError, match=rf"did you mean {meant}\?"):
        validate_settings(values, "settings.toml")


@pytest.mark.parametrize(
    "assume",
    [
        '[{ time = "gps" }, { sensor = "a", time = "gps" }]',
        '[{ sensor = "a", position_unit = "m" }, { sensor = "a", position_unit = "m" }]',
        '[{ sensor = "a", frame_time = "start" }, { frame_time = "end" }]',
    ],
)
def test_what_would_be_taken_back_twice_is_refused(assume):
    with pytest.raises(SettingsError, match=r"here: sensors\.assume: \w+ is assumed twice of a"):
        parse_settings(f"[sensors]\nassume = {assume}", "here")


def test_assumptions_of_different_sensors_or_things_are_taken():
    two = '{ sensor = "a", time = "gps" }, { sensor = "b", time = "gps" }'
    rest = '{ ahead_s = 1.0 }, { states = "TEME" }, { sensor = "a", states = "GCRF" }'
    found = parse_settings(f"[sensors]\nassume = [{two}, {rest}]", "here")
    assert len(found.sensors.assume) == 5

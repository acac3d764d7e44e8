"""The registries of methods: every entry resolves, and settings accept what they list."""

import inspect

import pytest

from epipole.schemas.errors import SettingsError
from epipole.schemas.given_settings import validate_settings
from epipole.schemas.options import (
    ASSOCIATION,
    STAR_CATALOGUES,
    STAR_IDENTIFICATION,
    TRACK_LINKING,
    load_function,
    load_method,
)
from epipole.schemas.settings import Settings

REGISTRIES = {
    "identification.method": STAR_IDENTIFICATION,
    "tracklets.link_method": TRACK_LINKING,
    "association.method": ASSOCIATION,
}


@pytest.mark.parametrize("registry", REGISTRIES.values(), ids=REGISTRIES)
def test_every_entry_is_a_function_and_all_of_a_registry_are_called_alike(registry):
    functions = [load_method(registry, name) for name in registry]
    assert len({len(inspect.signature(function).parameters) for function in functions}) == 1


@pytest.mark.parametrize("source", STAR_CATALOGUES.values(), ids=STAR_CATALOGUES)
def test_every_star_catalogue_is_a_function_that_is_called_without_arguments(source):
    parameters = inspect.signature(load_function(source.read)).parameters.values()
    assert all(parameter.default is not parameter.empty for parameter in parameters)


@pytest.mark.parametrize("setting", REGISTRIES)
def test_settings_accept_each_name_and_list_the_names_where_one_is_unknown(setting):
    group, field = setting.split(".")
    for name in REGISTRIES[setting]:
        chosen = validate_settings({group: {field: name}}, "here")
        assert getattr(getattr(chosen, group), field) == name
    with pytest.raises(SettingsError) as error:
        validate_settings({group: {field: "guess"}}, "here")
    assert all(repr(name) in str(error.value) for name in REGISTRIES[setting])


@pytest.mark.parametrize("setting", REGISTRIES)
def test_the_parameter_form_offers_the_names(setting):
    group, field = setting.split(".")
    reference = Settings.model_json_schema()["properties"][group]
    definition = reference.get("$ref", "").rsplit("/", 1)[-1]
    offered = Settings.model_json_schema()["$defs"][definition]["properties"][field]["enum"]
    assert offered == list(REGISTRIES[setting])

"""Parameters of the nightly flow: checked before a run is made, with a message for people."""

import datetime
from unittest.mock import patch

import pytest
from prefect.exceptions import ParameterTypeError
from prefect.utilities.callables import parameter_schema
from prefect.utilities.schema_tools.validation import ValidationError, validate

from epipole.flows.night import parameters
from epipole.flows.night.parameters import night_asked, run_name
from epipole.flows.nightly import nightly
from epipole.schemas.errors import EpipoleError

WRONG = [
    ({"night": "tonight"}, "field 'night'.*'tonight' does not match"),
    ({"night": "2019-4-1"}, "field 'night'.*'2019-4-1' does not match"),
    ({"settings": {"sensors": {"state_gap": 1}}}, r"'settings\.sensors'.*'state_gap' was unexp"),
    ({"settings": {"sensors": {"state_gap_s": -1}}}, r"'settings\.sensors\.state_gap_s'.*-1 is"),
    ({"settings": {"sensor": {}}}, "field 'settings'.*'sensor' was unexpected"),
    ({"logs": 1}, "field 'logs'"),
]


@pytest.mark.parametrize(("wrong", "says"), WRONG)
def test_the_server_refuses_a_wrong_parameter_and_names_it(wrong, says):
    schema = parameter_schema(nightly).model_dump_for_openapi()
    right = {"logs": "/data/logs", "out": "/data/dataset", "night": "yesterday", "settings": {}}
    assert validate(right, schema, raise_on_error=True) == []
    with pytest.raises(ValidationError, match=says):
        validate(right | wrong, schema, raise_on_error=True)


@pytest.mark.parametrize(("wrong", "_"), WRONG)
def test_the_flow_refuses_it_too(wrong, _):
    with pytest.raises(ParameterTypeError):
        nightly.validate_parameters({"logs": "a", "out": "b"} | wrong)


def test_the_form_on_the_page_says_what_each_parameter_is():
    properties = parameter_schema(nightly).properties
    assert all("description" in properties[name] for name in ("logs", "out", "night", "replace"))


def test_yesterday_is_the_day_before_the_run_was_scheduled():
    due = datetime.datetime(2019, 4, 2, 6, tzinfo=datetime.UTC)
    with patch.object(parameters, "flow_run", DueAt(due, {"night": "yesterday"})):
        assert night_asked("yesterday") == "2019-04-01"
        assert run_name() == "night 2019-04-01"
    zone = datetime.timezone(datetime.timedelta(hours=9))
    with patch.object(parameters, "flow_run", DueAt(due.astimezone(zone), {"logs": "/data/logs"})):
        assert night_asked("yesterday") == "2019-04-01"
        assert run_name() == "all nights of logs"


@pytest.mark.parametrize(
    ("logs", "name"),
    [
        ("/data/a.mcap", "a.mcap"), (["s3://b/logs/"], "logs"), (["a", "b"], "2 logs"), ("/", "/"),
        ("a\nb" * 40, ("a\\nb" * 40)[:60]),
    ],
)  # fmt: skip
def test_a_run_of_no_one_night_is_called_by_its_logs(logs, name):
    with patch.object(parameters, "flow_run", DueAt(None, {"logs": logs})):
        assert run_name().startswith(f"all nights of {name[:50]}")
        assert len(run_name()) < 90


class DueAt:
    def __init__(self, scheduled_start_time, parameters):
        self.scheduled_start_time = scheduled_start_time
        self.parameters = parameters


def test_a_day_that_no_month_has_is_an_error_of_the_run():
    with pytest.raises(EpipoleError, match=r"night 2019-02-30: no such date; give one such as"):
        night_asked("2019-02-30")
    with patch.object(parameters, "flow_run", DueAt(None, {"night": "2019-02-30"})):
        assert run_name() == "night 2019-02-30"

"""Stages and reasons: declared once, each with a sentence; packages and tasks follow."""

import importlib
import pkgutil
from pathlib import Path

import pytest
from prefect import Task

import epipole.tasks.common
from epipole.schemas.rejects import FrameStatus, Outcome, Reason, reject_rows
from epipole.schemas.stages import Stage

ROOT = Path(__file__).parents[2]
PACKAGE = "epipole.tasks"


@pytest.mark.parametrize("declared", [Stage, Reason, Outcome, FrameStatus])
def test_each_has_a_name_of_its_own_and_one_sentence(declared):
    assert len({str(member) for member in declared}) == len(declared)
    for member in declared:
        assert member == declared(str(member))
        assert member.sentence[0].isupper() or member.sentence.startswith("No "), member
        assert member.sentence.endswith("."), member
        assert ". " not in member.sentence, member


@pytest.mark.parametrize("stage", Stage)
def test_a_stage_is_a_package_whose_tasks_have_its_name(stage):
    package = importlib.import_module(f"{PACKAGE}.{stage}")
    assert f"Stage `{stage}`" in package.__doc__
    tasks = [
        value
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        for value in vars(importlib.import_module(module.name)).values()
        if isinstance(value, Task) and value.fn.__module__.startswith(package.__name__)
    ]
    assert tasks
    for task in tasks:
        assert task.name == stage
        assert task.task_run_name.startswith(f"{stage} ")  # else Prefect adds random letters


def test_other_packages_of_tasks_have_no_tasks():
    for module in pkgutil.iter_modules(epipole.tasks.common.__path__):
        names = vars(importlib.import_module(f"{PACKAGE}.common.{module.name}"))
        assert not [name for name, value in names.items() if isinstance(value, Task)]


def test_rows_of_rejects_take_their_stage_from_the_reason():
    rows = reject_rows([Reason.NAN, Reason.CLOCK_OFF], time=[1000, 2000], count=[1, 2])
    assert rows["stage"].to_pylist() == ["read", "check"]
    assert rows["reason"].to_pylist() == ["nan", "clock_off"]
    assert rows["sensor_id"].null_count == rows["tracklet_id"].null_count == 2
    assert reject_rows(Reason.NAN, time=[], count=[]).num_rows == 0

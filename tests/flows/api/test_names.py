"""The public names: few, documented, and their examples run."""

import doctest
import inspect
from importlib.metadata import version
from pathlib import Path

import pytest

from epipole.flows import api

ROOT = Path(__file__).parents[3]
FUNCTIONS = [name for name in api.__all__ if inspect.isfunction(getattr(api, name))]


def test_the_version_is_that_of_the_package():
    assert api.__version__ == version("epipole")


@pytest.mark.parametrize("name", [name for name in api.__all__ if name != "__version__"])
def test_each_name_says_what_it_is(name):
    assert inspect.getdoc(getattr(api, name))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_docstring_of_a_function_has_all_its_parts(name):
    doc = inspect.getdoc(getattr(api, name))
    for part in ("Parameters", "Raises", "Examples"):
        assert f"\n{part}\n---" in doc, part
    for parameter in inspect.signature(getattr(api, name)).parameters:
        assert parameter in doc.partition("Parameters\n")[2].partition("Raises\n")[0], parameter


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_examples_run(name, example, monkeypatch, tmp_path):
    for link, target in (("examples", ROOT / "examples"), ("out", example / "out")):
        (tmp_path / link).symlink_to(target)
    monkeypatch.chdir(tmp_path)
    function = getattr(api, name)
    tests = doctest.DocTestFinder(recurse=False).find(function, name, globs={})
    assert tests
    for test in tests:
        assert test.examples
        assert doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(test).failed == 0

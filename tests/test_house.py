"""The house: packages are named and full, modules are not too long, class names are unique."""

import ast
import collections
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = ("schemas", "io", "tasks", "flows")
MODULES = sorted(path for folder in FOLDERS for path in (ROOT / folder).rglob("*.py"))
MIN_MODULES = 4  # of a package, its __init__.py aside
# Smaller packages, each with its reason.
SMALL = {
    "io/simulation": "the simulator's own: the pipeline may not read it",
    "tasks": "the stages are sub-packages",
    "tasks/algorithms/sensor_faults": "above all other mathematics",
    "tasks/algorithms/tracking/linking": "a published method beside the default",
    "tasks/track": "a stage",
    "tasks/simulate": "a flow's tasks: the pipeline may not read it",
}
MAX_MODULE_LINES = 600
LONGEST_LINES = 60  # of a function's body, below its signature and docstring
MAX_PARAMETERS = 12  # kernels take named tuples
MAX_OPTIONS = 17  # of a command, `epipole run`: each option is a parameter


def packages() -> list[str]:
    inits = (path.parent for path in MODULES if path.name == "__init__.py")
    return sorted("epipole." + ".".join(path.relative_to(ROOT).parts) for path in inits)


def functions():
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                yield path.relative_to(ROOT), node


def test_every_package_is_installed():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert sorted(project["tool"]["setuptools"]["packages"]) == packages()


def test_every_folder_with_modules_is_a_package_that_says_what_it_holds():
    for folder in {path.parent for path in MODULES}:
        init = folder / "__init__.py"
        assert init.exists(), folder
        assert ast.get_docstring(ast.parse(init.read_text())), folder


def test_a_package_has_four_modules_or_a_reason():
    count = collections.Counter(
        path.parent.relative_to(ROOT).as_posix() for path in MODULES if path.name != "__init__.py"
    )
    assert {folder for folder, n in count.items() if n < MIN_MODULES} == set(SMALL)


def test_no_module_is_too_long():
    lines = {str(path): len(path.read_text().splitlines()) for path in MODULES}
    assert {path: n for path, n in lines.items() if n > MAX_MODULE_LINES} == {}


def test_a_class_name_is_declared_once():
    where = collections.defaultdict(list)
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ClassDef):
                where[node.name].append(str(path.relative_to(ROOT)))
    assert {name: files for name, files in where.items() if len(files) > 1} == {}


def test_functions_are_short():
    long = []
    for path, node in functions():
        body = node.body[1:] if ast.get_docstring(node) else node.body
        if body and node.end_lineno - body[0].lineno >= LONGEST_LINES:
            long.append(f"{path}: {node.name}")
    assert long == []


def test_kernels_say_what_they_take():
    """Their arguments have no types: the docstring is all that a reader has."""
    silent = [
        f"{path}: {node.name}"
        for path, node in functions()
        if any(ast.unparse(by).endswith("kernel") for by in node.decorator_list)
        and not ast.get_docstring(node)
    ]
    assert silent == []


def test_functions_have_few_parameters():
    many = [
        f"{path}: {node.name}"
        for path, node in functions()
        if len(node.args.args + node.args.kwonlyargs + node.args.posonlyargs)
        > (MAX_OPTIONS if path.parent.name == "command_line" else MAX_PARAMETERS)
    ]
    assert many == []


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_test_file_lies_where_its_module_lies(folder):
    """Tests of several modules have a name of their own, but never another folder's."""
    for path in (ROOT / "tests" / folder).rglob("test_*.py"):
        assert (ROOT / path.relative_to(ROOT / "tests").parent).is_dir(), path

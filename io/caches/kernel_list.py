"""Which kernels a run calls from Python, and with which types: a list that comes with the code.

With it they can be compiled before there is anything to call them with. The list is made from a
run of the example; a test holds the two against each other.
"""

import importlib
import tomllib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from numba import types

Signature = tuple[types.Type, ...]

KERNELS = Path(__file__).parent / "kernels.toml"


def read_kernels(path: Path = KERNELS) -> list[tuple[str, list[str]]]:
    """Return kernels as "module:name", each with its arguments' types as text, in order."""
    kernels = tomllib.loads(path.read_text(encoding="utf-8"))
    return [(name, arguments) for name, arguments in kernels.items()]


def kernel(name: str) -> Any:
    """Return what "module:name" names."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def signature(arguments: Iterable[str]) -> Signature:
    """Return numba's types of text that `kernels_text` wrote."""
    known = {**vars(types), "named": _named}
    return tuple(eval(text, {"__builtins__": {}}, known) for text in arguments)


def _named(name: str, *fields: types.Type) -> types.NamedTuple:
    return types.NamedTuple(fields, kernel(name))

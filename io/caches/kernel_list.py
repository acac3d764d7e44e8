"""The list of the kernels that a run calls from Python, with the types of their arguments.

With it the kernels can be compiled before a run needs them. The list is made from a run of the
example, and a test compares the two.
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
    """Return the kernels as "module:name", each with the types of its arguments as text."""
    kernels = tomllib.loads(path.read_text(encoding="utf-8"))
    return [(name, arguments) for name, arguments in kernels.items()]


def kernel(name: str) -> Any:
    """Return the object called "module:name"."""
    module, _, attribute = name.partition(":")
    return getattr(importlib.import_module(module), attribute)


def signature(arguments: Iterable[str]) -> Signature:
    """Return numba's types for the types of arguments as text."""
    known = {**vars(types), "named": _named}
    return tuple(eval(text, {"__builtins__": {}}, known) for text in arguments)


def _named(name: str, *fields: types.Type) -> types.BaseTuple:
    """Return the type of a named tuple; numba has one for fields of equal types, one for others."""
    return types.BaseTuple.from_types(fields, kernel(name))

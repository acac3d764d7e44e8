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
_HEAD = """\
# The kernels that a run of the example calls from Python, in the order of their first call,
# with the types of their arguments. Written by `python tests/test_kernel_list.py`.
"""


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


def kernels_text(called: Iterable[tuple[str, Signature]]) -> str:
    """Return the list of kernels ("module:name") with their arguments' types, as TOML."""
    blocks = []
    for name, arguments in called:
        lines = "".join(f"    {_quoted(_text(argument))},\n" for argument in arguments)
        blocks.append(f'"{name}" = [\n{lines}]\n')
    return "\n".join([_HEAD, *blocks])


def _named(name: str, *fields: types.Type) -> types.NamedTuple:
    return types.NamedTuple(fields, kernel(name))


def _text(argument: Any) -> str:
    if isinstance(argument, types.Array):
        if not argument.mutable:
            return f"Array({argument.dtype}, {argument.ndim}, {argument.layout!r}, readonly=True)"
        last = "::1" if argument.layout == "C" else ":"
        return f"{argument.dtype}[{', '.join([':'] * (argument.ndim - 1) + [last])}]"
    inside = getattr(argument, "types", ())
    fields = ", ".join(_text(one) for one in inside)
    if isinstance(argument, types.BaseNamedTuple):
        made = argument.instance_class  # type: ignore[attr-defined]
        return f"named('{made.__module__}:{made.__name__}', {fields})"
    if isinstance(argument, types.BaseTuple):
        return f"Tuple(({fields},))"
    return str(argument)


def _quoted(text: str) -> str:
    return f'"{text}"'

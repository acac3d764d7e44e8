"""Little-endian numbers out of bytes at any place, for compiled loops."""

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic


def _load(bits: int, kind: Any) -> Any:
    """Return a function of (bytes, place): one load instruction, for which numba has no function.

    The bytes must reach beyond the number: no bound is checked.
    """

    @intrinsic
    def load(typing_context, data, at):
        def code(context, builder, signature, values):
            array = context.make_array(signature.args[0])(context, builder, values[0])
            place = builder.gep(array.data, [values[1]])
            pointer = builder.bitcast(place, ir.IntType(bits).as_pointer())
            return builder.load(pointer, align=1)

        return kind(data, types.int64), code

    return load


load_uint16 = _load(16, types.uint16)
load_int32 = _load(32, types.int32)
load_uint32 = _load(32, types.uint32)
load_uint64 = _load(64, types.uint64)
